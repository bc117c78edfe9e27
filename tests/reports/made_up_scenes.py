"""A run folder as the stages before the report leave it, made up through the schemas."""

import json
import re
from collections.abc import Callable
from html import unescape
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.splits import leak_seconds
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from groundwalk.reports import stage as report_stage
from groundwalk.reports.definition import STAGE
from groundwalk.reports.figures import Picture
from groundwalk.reports.inputs import SceneInputs
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store.files import hash_files, write_json
from groundwalk.store.schemas import stage_tables
from groundwalk.store.settings import DataRoot
from groundwalk.store.stage import execute
from groundwalk.store.tables import pose_frame, write_table
from tests.known import cells, filled, table_of

SECOND = 1_000_000_000
MODELS = ("PN", "MS-T")
METHODS = (
    ("raw", "{}", "predictor alone", False, True, "the raw regressor"),
    ("paper_rule", '{"gamma": 0.99}', "VIO", True, True, "the paper's rule"),
    ("smoother", "{}", "smoother", True, False, "from the whole walk"),
)


class MadeUpScene:
    """One scene's tables: walks around a 40 x 30 m place, a heavy-tailed regressor, a fused method."""

    def __init__(
        self, name: str, seed: int, train: int = 60, test: int = 30, mixed: bool = False, uncertain: float = 0.0,
        localisers: tuple[str, ...] = (), scale_source: str = "vio", without_vio: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        self.without_vio = without_vio
        self.name, self.localisers, self.scale_source = name, localisers, scale_source
        self.models = (*MODELS, *localisers)
        self.rng = np.random.default_rng(seed)
        splits = {"walk_1": "train", "walk_2": "train", "walk_3": "test", "walk_4": "test"}
        rows, poses = [], []
        for number, (session, split) in enumerate(splits.items()):
            count = train if split == "train" else test
            angle = np.linspace(0, 2 * np.pi, count) + 0.3 * number
            xyz = np.stack(
                [(20 - number) * np.cos(angle), 1.5 + 0.1 * np.sin(5 * angle), (15 - number) * np.sin(angle)], 1
            )
            poses.append(make_pose(yaw_rotation(-angle), xyz))
            for i in range(count):
                part = "val" if split == "train" and i >= count - count // 10 else split
                part = ("test" if i >= 0.75 * count else "train") if mixed else part
                rows.append(
                    {"frame_id": f"{session}/{i:06d}", "session_id": session, "split": part, "t_ns": i * SECOND}
                )
        self.map_T_cam = np.concatenate(poses)
        self.frames = pd.DataFrame(rows)
        # A share of all frames, spread evenly, has ground truth of class C.
        every = np.arange(len(self.frames)) * uncertain
        self.quality = np.where(np.floor(every + uncertain) > np.floor(every), "C", "A")

    def disturbed(self, metres: float, degrees: float) -> Array:
        """The true poses with heavy-tailed errors."""
        count = len(self.frames)
        offset = self.rng.standard_t(2, (count, 3)) * metres
        turn = Rotation.from_rotvec(np.radians(self.rng.standard_t(2, (count, 3)) * degrees)).as_matrix()
        return make_pose(turn @ self.map_T_cam[:, :3, :3], self.map_T_cam[:, :3, 3] + offset)

    def tables(self) -> dict[str, dict[str, pd.DataFrame]]:
        """All stages' tables; in sessions `without_vio` there is none, and nothing is fused."""
        tables = self._with_vio()
        if not self.without_vio:
            return tables
        imported, fuse = tables["import"], tables["fuse"]
        vio = [c for c in imported["frames"].columns if c.startswith(("vio_cam_", "gravity_"))]
        imported["frames"].loc[imported["frames"]["session_id"].isin(self.without_vio), vio] = np.nan
        alone = imported["sessions"]["session_id"].isin(self.without_vio)
        imported["sessions"].loc[alone, ["pose_source", "reference_unit"]] = "reference", "m"
        for name in ("poses", "errors", "sessions"):
            table = fuse[name]
            fuse[name] = table[(table["method"] == "raw") | ~table["session_id"].isin(self.without_vio)]
        ran = set(fuse["errors"].loc[fuse["errors"]["split"] == "test", "method"])
        if ran == {"raw"}:
            for name in ("poses", "errors", "sessions", "methods", "intervals"):
                fuse[name] = fuse[name][fuse[name]["method"] == "raw"]
        residuals = tables["align"]["residuals"]
        tables["align"]["residuals"] = residuals[~residuals["session_id"].isin(self.without_vio)]
        if alone.all():
            tables["align"]["drift"] = tables["align"]["drift"].iloc[:0]
        return tables

    def _with_vio(self) -> dict[str, dict[str, pd.DataFrame]]:
        frames, count = self.frames, len(self.frames)
        camera = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0}
        gravity = {"gravity_x": 1.0, "gravity_y": 0.0, "gravity_z": 0.0}
        vio, images = pose_frame("vio_cam", self.map_T_cam), frames["frame_id"] + ".jpg"
        imported = filled("import", "frames", count, **frames, **vio, **camera, **gravity, image=images)
        imported = imported.assign(width=64, height=48)
        # A support frame, which SfM didn't register: no figure of the report may count it.
        support = imported.iloc[[0]].assign(frame_id="walk_1/000900", t_ns=SECOND // 2, support=True)
        imported = pd.concat([imported, support], ignore_index=True)
        truth = filled("align", "ground_truth", count, **frames, **camera, **pose_frame("map_cam", self.map_T_cam))
        truth = truth.assign(
            position_sd_m=0.005,
            rotation_sd_deg=0.02,
            quality=self.quality,
            scale_source=self.scale_source,
            vertical_source="none" if self.scale_source == "none" else "gravity",
            component=0,
        )
        # One test frame without ground truth: it can't be scored, and must be counted as such.
        lost = truth.index[truth["split"] == "test"][3]
        truth.loc[lost, [c for c in truth.columns if c.startswith("map_cam")]] = np.nan
        truth.loc[lost, ["quality", "reason"]] = "none", "not registered"
        localised, predictions, poses, errors = [filled("localise", "predictions", 0)], [], [], []
        for model in self.models:
            raw = self.disturbed(0.6, 2.0)
            keys: dict[str, Any] = {"model": model, "scene": self.name, "picked_scene": self.name, **frames}
            if model in self.localisers:
                raw = np.where(self.refused[:, None, None], np.nan, self.map_T_cam)
                refusal = cells("thin_evidence" if refused else None for refused in self.refused)
                keys |= {"refusal": refusal, "reason": refusal, "cpu_ms": 80.0, "inliers": 90, "inference_ms": 60.0}
                localised.append(filled("localise", "predictions", count, **keys, **pose_frame("map_cam", raw)))
            else:
                answers = pose_frame("map_cam", raw)
                predictions.append(filled("train", "predictions", count, **keys, **answers, inference_ms=12.0))
            for method, options, *_ in METHODS:
                fused, errs = self._fused(model, method, options, raw)
                poses.append(fused)
                errors.append(errs.drop(index=lost))
        seen = pose_frame("sfm_cam", np.where((np.arange(count) == lost)[:, None, None], np.nan, self.map_T_cam))
        ids, is_registered = frames["frame_id"], frames.index != lost
        registered = filled("sfm", "images", count, frame_id=ids, registered=is_registered, **seen)
        unregistered = registered.iloc[[lost]].assign(frame_id="walk_1/000900")
        return {
            "import": {
                "frames": imported,
                "sessions": self._sessions(),
                "rejects": self._rejects(),
                "jumps": filled("import", "jumps", 0),
            },
            "sfm": {"images": pd.concat([registered, unregistered], ignore_index=True)},
            "align": {
                "ground_truth": truth,
                "sessions": self._aligned(),
                "drift": self._drift(),
                "checks": self._checks(),
                "residuals": self._residuals(lost),
                "control": self._control(),
            },
            "localise": {"predictions": pd.concat(localised), "models": self._maps()},
            "train": {"predictions": pd.concat(predictions), "history": self._history(), "models": self._cards()},
            "fuse": {
                "poses": pd.concat(poses),
                "errors": pd.concat(errors),
                "intervals": self._intervals(),
                "sessions": self._fused_sessions(),
                "methods": pd.DataFrame(METHODS, columns=["method", "options", "label", "fuses", "causal", "meaning"]),
            },
        }

    @property
    def refused(self) -> Array:
        """The frames (N,) that each structure localiser refuses: every sixth."""
        return np.arange(len(self.frames)) % 6 == 0

    def _control(self) -> pd.DataFrame:
        figures = {
            "points": 13,
            "used": 12,
            "held_out": 12,
            "rms_m": 0.0064,
            "expected_rms_m": 0.0084,
            "worst_m": 0.015,
        }
        figures |= {"within_bounds": 0.917, "scale": 0.0007, "scale_sd": 0.0001, "tilt_deg": 0.031, "tilt_sd_deg": 0.16}
        return filled("align", "control", 1, control="total station", fit="se3", status="passed", **figures)

    def _maps(self) -> pd.DataFrame:
        names, cost = [*self.localisers], {"inference_ms": 60.0, "cpu_ms": 80.0, "build_cpu_seconds": 7.0}
        what = {"meaning": "a made-up map", "file": "map.gwm", "bytes": 3 << 19, "device": "made-up cores"}
        return filled("localise", "models", len(names), model=names, label=names, train_frames=108, **what, **cost)

    def _fused_sessions(self) -> pd.DataFrame:
        """As good as odometry can be, but that `raw` never answers in walk_4."""
        rows = []
        for model, (method, options, *_), session in product(self.models, METHODS, ("walk_3", "walk_4")):
            never = method == "raw" and session == "walk_4"
            row: dict[str, object] = {"method": method, "options": options, "model": model, "scene": self.name}
            row |= {"session_id": session, "split": "test", "frames": 30, "answered": 0 if never else 27}
            row |= {"first_fix_s": None if never else 3.0, "longest_outage_s": None if never else 4.25}
            row |= {"jitter_m": 0.125, "jitter_deg": 0.75, "recovery_s": np.inf if method == "paper_rule" else None}
            rows.append(row)
        return pd.DataFrame(rows)

    def _intervals(self) -> pd.DataFrame:
        rows = []
        for model in self.models:
            for method, value in (("raw", 2.0), ("paper_rule", 1.5), ("smoother", 1.0)):
                key: dict[str, object] = {"method": method, "options": "{}"}
                key |= {"model": model, "scene": self.name, "subset": "all"}
                key |= {"value": value, "low": 0.8 * value, "high": None if method == "raw" else 1.3 * value}
                figures = ("position_median_m", "rotation_mean_deg")
                rows += [key | {"figure": figure, "sessions": 2, "draws": 3} for figure in figures]
        return pd.DataFrame(rows)

    def _fused(self, model: str, method: str, options: str, raw: Array) -> tuple[pd.DataFrame, pd.DataFrame]:
        count = len(self.frames)
        keys = self.frames.assign(model=model, method=method, options=options, scene=self.name)
        if method == "raw":
            status = live = np.full(count, "predicted", object)
            fused = live_poses = raw
        elif method == "smoother":
            status = live = np.full(count, "fused", object)
            # It misses a frame that the causal ones answer.
            missed = (self.frames["t_ns"] == 9 * SECOND).to_numpy()
            fused = live_poses = np.where(missed[:, None, None], np.nan, self.disturbed(0.1, 0.3))
        else:
            first = (self.frames["t_ns"] < 4 * SECOND).to_numpy()
            status = self.rng.choice(["reliable", "optimised", "aligning"], count, p=[0.5, 0.4, 0.1]).astype(object)
            status[first] = "reliable"
            live = np.where(first, "none", status)
            fused = np.where((status == "reliable")[:, None, None], raw, self.disturbed(0.3, 0.8))
            live_poses = np.where(first[:, None, None], np.nan, fused)
        poses = pd.concat([keys, pose_frame("map_cam", fused), pose_frame("live_map_cam", live_poses)], axis=1)
        poses = pd.concat([poses, pose_frame("map_vio", np.full((count, 4, 4), np.nan))], axis=1)
        poses = poses.assign(status=status, live_status=live, covariance=None, reasons="")
        errors = keys.assign(status=status, live_status=live, quality=self.quality)
        for prefix, estimate in (("", fused), ("live_", live_poses), ("raw_", raw)):
            known = np.isfinite(estimate).all(axis=(1, 2))
            for name, error in (("position_m", position_error), ("rotation_deg", rotation_error_deg)):
                values = np.full(count, np.nan)
                values[known] = error(estimate[known], self.map_T_cam[known])
                errors[prefix + name] = values
        return poses, errors

    def _sessions(self) -> pd.DataFrame:
        walks = self.frames.groupby("session_id")
        counts, names = walks.size().to_numpy(), [str(name) for name in walks.groups]
        return filled(
            "import", "sessions", len(names), session_id=names, recording=names, format="3d_scanner_app",
            device="made up", duration_s=counts - 1.0, path_m=110.0, pose_source="vio", up="+y", up_source="format",
            poses=counts, images=counts, frames=counts,
            split=walks["split"].last().replace("val", "train").to_numpy(),
        )  # fmt: skip

    def _rejects(self) -> pd.DataFrame:
        rows = [
            ("walk_1", "frame_00007.json", "image is broken: truncated after 20 bytes", "image"),
            ("walk_1", "frame_00008.json", "image is broken: truncated after 7 bytes", "image"),
            ("walk_1", "frame_00009.json", "not tracking", "pose"),
            ("walk_2", "depth_00003.png", "depth image is broken; its image is used without", "depth"),
            ("walk_2", "frame_00004.json", "no number", None),
            ("walk_3", "walk_3", "a video can't be read: 0 bytes", "recording"),
        ]
        table = pd.DataFrame(rows, columns=["session_id", "source", "reason", "rejected"])
        return filled("import", "rejects", len(rows), **table)

    def _aligned(self) -> pd.DataFrame:
        names = sorted(set(self.frames["session_id"]))
        identity = pose_frame("map_vio", np.tile(np.eye(4), (len(names), 1, 1)))
        known = {"frames": 30, "with_ground_truth": 30, "scale_source": "vio", "scale": 1.003}
        return filled("align", "sessions", len(names), session_id=names, t_end_ns=10**15, **known, **identity)

    def _residuals(self, lost: int) -> pd.DataFrame:
        """VIO moves away by a millimetre a frame."""
        off = 0.001 * self.frames.groupby("session_id").cumcount()
        keys = self.frames.drop(columns="split")
        table = filled("align", "residuals", len(keys), **keys, position_m=off, rotation_deg=off)
        return table.drop(index=lost)

    def _drift(self) -> pd.DataFrame:
        rows = []
        figures = {"samples": 40, "mean": 1.0, "median": 0.9, "rms": 1.1, "p95": 2.0, "max": 2.5}
        for session in ("walk_1", "walk_2", "all"):
            for distance in (5.0, 10.0, 20.0, 50.0):
                rows.append((session, "distance_position", distance, "m", "%", 1 + distance / 50))
            rows.append((session, "relative_position", 1.0, "s", "m", 0.01))
            rows.append((session, "paper_rpe", 1.0, "pair", "m", 0.006))
            rows.append((session, "ate_se3", np.nan, "path", "m", 0.2))
        columns = ["session_id", "definition", "interval", "interval_unit", "unit", "factor"]
        frame = pd.DataFrame(rows, columns=columns)
        for name, figure in figures.items():
            frame[name] = figure if name == "samples" else figure * frame["factor"]
        return frame.drop(columns="factor")

    def _checks(self) -> pd.DataFrame:
        return filled(
            "align", "checks", 3, check=["window_position", "window_position", "ruler_scale"], frames=10, unit="m",
            session_id=["walk_1", "walk_2", "walk_2"], status=["passed", "failed", "undecided"], limit=[0.1, 0.1, 0.03],
            value=[0.01, 0.3, None], reason=["", "pose in SfM inconsistent with VIO", "board: seen once"],
        )  # fmt: skip

    def _history(self) -> pd.DataFrame:
        table = pd.DataFrame(product(MODELS, range(1, 13)), columns=["model", "epoch"])
        errors = {"train_loss": 3 / table["epoch"] - 1, "val_position_m": 6 / table["epoch"]}
        selected = {"selected": table["epoch"] == 11, "scenes": cells([[self.name]] * len(table))}
        return filled("train", "history", len(table), **table, **errors, **selected)

    def _cards(self) -> pd.DataFrame:
        return filled(
            "train", "models", 2, model=MODELS, label=MODELS, scenes=cells([[self.name]] * 2), file=["pn.pt", "mst.pt"],
            weights="scratch: no internet", layers=["", "2+2 layers"], bytes=[89_430_000, 60_000_000], crop_px=224,
            epochs=12, train_frames=108, device="made-up processor, float32",
            reduced=["", "2+2 instead of 6+6 transformer layers"],
        )  # fmt: skip


def write_scene(data: DataRoot, scene: MadeUpScene, simulated: bool) -> None:
    """The scene's artefacts up to fuse, and its images."""
    tables = scene.tables()
    for stage, of_stage in tables.items():
        write_stage(data, scene.name, stage, of_stage, simulated)
    for image in tables["import"]["frames"]["image"]:
        path = data.captures(scene.name) / image
        path.parent.mkdir(parents=True, exist_ok=True)
        grey = np.tile(np.linspace(0, 255, 64, dtype=np.uint8), (48, 1))
        cv2.imwrite(str(path), grey)


def write_group(data: DataRoot, name: str, members: list[str]) -> None:
    """A group of written scenes that trained one MS-T for all, which is half as wrong as their own, and fused it."""
    config = f'environment = "outdoor"\nmembers = {json.dumps(members)}\nstages = ["train", "fuse", "report"]\n'
    (data.root / "scenes").mkdir(exist_ok=True)
    (data.root / "scenes" / f"{name}.toml").write_text(config)

    def joined(stage: str, table: str) -> pd.DataFrame:
        return pd.concat([table_of(data, member, stage, table) for member in members], ignore_index=True)

    train = {table: joined("train", table) for table in ("predictions", "history", "models")}
    train = {table: frame[frame["model"] == "MS-T"] for table, frame in train.items()}
    for table in ("history", "models"):
        train[table] = train[table].drop_duplicates("epoch" if table == "history" else "model").copy()
        train[table]["scenes"] = [members] * len(train[table])
    errors = joined("fuse", "errors")
    columns = [c for c in errors.columns if c.endswith(("position_m", "rotation_deg"))]
    errors.loc[errors["model"] == "MS-T", columns] *= 0.5
    write_stage(data, name, "train", train, True)
    fused = {table: joined("fuse", table) for table in ("poses", "intervals", "sessions")}
    fused["methods"] = joined("fuse", "methods").drop_duplicates()
    write_stage(data, name, "fuse", fused | {"errors": errors}, True)


def write_stage(data: DataRoot, scene: str, stage: str, tables: dict[str, pd.DataFrame], simulated: bool) -> None:
    folder = data.run("tiny", scene, stage)
    folder.mkdir(parents=True)
    for table in stage_tables(stage):
        if table.name in tables:
            write_table(folder / f"{table.name}.parquet", tables[table.name], table)
    figures: dict[str, Any] = {}
    if stage == "align":
        figures |= {"scale_source": "vio", "scale_sd": 0.004, "vertical_source": "gravity", "vertical_sd_deg": 0.1}
    if stage == "import":
        frames = tables["frames"].assign(recording=tables["frames"]["session_id"])
        figures["leak_s"] = leak_seconds(frames, frames["split"].to_numpy(object))
    write_json(
        folder / "manifest.json",
        {
            "stage": stage, "seed": 0, "profile": "tiny", "scene": {"name": scene}, "inputs": {},
            "simulated": simulated, "settings": {"made": "up"}, "figures": figures,
            "seconds": {"step": 1.5}, "total_seconds": 2.0, "finished": "2026-01-01T00:00:00+00:00",
            "peak_memory_mib": 100.0, "versions": {"numpy": "2"}, "git_revision": "abc", "machine": "made up",
            "outputs": hash_files(folder, folder.glob("*.parquet")),
        },
    )  # fmt: skip


def page_of(folder: Path, file: str = "page.html") -> str:
    return (folder / file).read_text(encoding="utf-8")


def rows_of(folder: Path, table: str, file: str = "page.html") -> list[list[str]]:
    """The cells of a table of a page, row by row."""
    page = page_of(folder, file)
    part = page[page.index(f'id="{table}"') :]
    rows = re.findall(r"<tr.*?</tr>", part[: part.index("</table>")])
    return [list(map(unescape, cells)) for row in rows if (cells := re.findall(r"<td[^>]*>(.*?)</td>", row))]


@pytest.fixture(scope="session")
def make_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., DataRoot]:
    """A function that makes a data folder with these scenes, and a group of them where it's named:
    `make_run(Church={"train": 60}, simulated=True)`."""

    def make(simulated: bool = True, group: str = "", **scenes: Any) -> DataRoot:
        data = DataRoot(tmp_path_factory.mktemp("data"))
        for seed, (name, options) in enumerate(scenes.items()):
            write_scene(data, MadeUpScene(name, seed, **options), simulated)
        if group:
            write_group(data, group, list(scenes))
        return data

    return make


def _no_pictures(scene: SceneInputs, folder: Path) -> dict[str, list[Picture]]:
    return {part: [] for part in ("drift", "training", "errors")}


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_stage, "scene_figures", _no_pictures)


def report_without_figures(data: DataRoot, scene: str) -> Path:
    """The report's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_stage, "scene_figures", _no_pictures)
        return execute(STAGE, scene, "tiny", data)
