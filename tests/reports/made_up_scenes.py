"""A run folder as the stages before the report leave it, made up through the schemas."""

import json
from collections.abc import Callable
from itertools import product
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.splits import leak_seconds
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store.choices import NotRegistered
from groundwalk.store.files import hash_files, write_json
from groundwalk.store.schemas import schema, stage_tables
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import pose_frame, read_table, write_table
from tests.known import cells

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
        localisers: tuple[str, ...] = (), appearances: tuple[str, str] = ("same", "same"),
        scale_source: str = "vio", without_vio: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        self.without_vio = without_vio
        self.name, self.localisers, self.scale_source = name, localisers, scale_source
        self.appearances = dict(zip(("walk_3", "walk_4"), appearances, strict=True))
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
            del fuse["sweep"]
        residuals = tables["align"]["residuals"]
        tables["align"]["residuals"] = residuals[~residuals["session_id"].isin(self.without_vio)]
        if alone.all():
            tables["align"]["drift"] = tables["align"]["drift"].iloc[:0]
        return tables

    def _with_vio(self) -> dict[str, dict[str, pd.DataFrame]]:
        frames = self.frames
        imported = pd.concat([frames, pose_frame("vio_cam", self.map_T_cam)], axis=1).assign(
            clock="boot", image=frames["frame_id"] + ".jpg", image_sha256="", width=64, height=48, fx=50.0, fy=50.0,
            cx=32.0, cy=24.0, distortion=cells([] for _ in range(len(frames))),
            gravity_x=1.0, gravity_y=0.0, gravity_z=0.0, tracking="normal", first_row="top",
            sharpness=0.5,
            stated_readout_s=None, focal_sd=0.0, exposure_s=0.01, blurred_faces=None, blurred_plates=None,
            support=False, depth=None, depth_confidence=None, depth_sha256=None,
        )  # fmt: skip
        # A support frame, which SfM didn't register: no figure of the report may count it.
        support = imported.iloc[[0]].assign(frame_id="walk_1/000900", t_ns=SECOND // 2, support=True)
        imported = pd.concat([imported, support], ignore_index=True)
        truth = pd.concat([frames, pose_frame("map_cam", self.map_T_cam)], axis=1).assign(
            covariance=None,
            position_sd_m=0.005,
            rotation_sd_deg=0.02,
            quality=self.quality,
            reason="",
            gt_uses_vio=False,
            scale_source=self.scale_source,
            vertical_source="none" if self.scale_source == "none" else "gravity",
            component=0,
            fx=50.0, fy=50.0, cx=32.0, cy=24.0, distortion=cells([[0.09, -0.12, 0.0, 0.0]] * len(frames)),
            camera_origin="estimated",
        )  # fmt: skip
        # One test frame without ground truth: it can't be scored, and must be counted as such.
        lost = truth.index[truth["split"] == "test"][3]
        truth.loc[lost, [c for c in truth.columns if c.startswith("map_cam")]] = np.nan
        truth.loc[lost, ["quality", "reason"]] = "none", "not registered"
        localised, predictions, poses, errors = [], [], [], []
        for model in self.models:
            raw = self.disturbed(0.6, 2.0)
            if model in self.localisers:
                raw = np.where(self.refused[:, None, None], np.nan, self.map_T_cam)
                localised.append(self._localised(model, raw))
            else:
                predictions.append(
                    pd.concat([frames, pose_frame("map_cam", raw)], axis=1).assign(
                        model=model, scene=self.name, covariance=None, picked_scene=self.name, inference_ms=12.0
                    )
                )
            for method, options, *_ in METHODS:
                fused, errs = self._fused(model, method, options, raw)
                poses.append(fused)
                errors.append(errs.drop(index=lost))
        return {
            "import": {
                "frames": imported,
                "sessions": self._sessions(),
                "rejects": self._rejects(),
                "jumps": pd.DataFrame(columns=schema("import", "jumps").column_names),
            },
            "sfm": {"images": self._images(lost)},
            "align": {
                "ground_truth": truth,
                "sessions": self._aligned(),
                "drift": self._drift(),
                "checks": self._checks(),
                "residuals": self._residuals(lost),
            },
            "localise": self._localise(localised),
            "train": {"predictions": pd.concat(predictions), "history": self._history(), "models": self._cards()},
            "fuse": {
                "poses": pd.concat(poses),
                "errors": pd.concat(errors),
                "sweep": self._sweep(),
                "intervals": self._intervals(),
                "sessions": self._fused_sessions(),
                "methods": pd.DataFrame(METHODS, columns=["method", "options", "label", "fuses", "causal", "meaning"]),
            },
        }

    @property
    def refused(self) -> Array:
        """The frames (N,) that each structure localiser refuses: every sixth."""
        return np.arange(len(self.frames)) % 6 == 0

    def _localised(self, model: str, poses: Array) -> pd.DataFrame:
        refusal = pd.Series(cells("thin_evidence" if refused else None for refused in self.refused), dtype=object)
        return pd.concat([self.frames, pose_frame("map_cam", poses)], axis=1).assign(
            model=model, scene=self.name, picked_scene=self.name, covariance=None, inference_ms=60.0, cpu_ms=80.0,
            inliers=90, candidates=120, refusal=refusal, reason=refusal,
        )  # fmt: skip

    def _localise(self, localised: list[pd.DataFrame]) -> dict[str, pd.DataFrame]:
        keys = {name: schema("localise", name).column_names for name in ("predictions", "models", "storage")}
        models = [
            {"model": model, "label": model, "meaning": "a made-up map", "file": "map.gwm", "bytes": 3 << 19,
             "points": 2000, "train_frames": 108, "seed": 0, "config": "{}", "device": "made-up cores",
             "inference_ms": 60.0, "cpu_ms": 80.0, "build_cpu_seconds": 7.0}
            for model in self.localisers
        ]  # fmt: skip
        storage = [
            {"model": model, "part": part, "bytes": size << 19}
            for model in self.localisers
            for part, size in (("descriptors", 2), ("points", 1))
        ]
        tables = {"predictions": localised, "models": [pd.DataFrame(models)], "storage": [pd.DataFrame(storage)]}
        return {
            name: pd.concat(rows)[keys[name]] if self.localisers else pd.DataFrame(columns=keys[name])
            for name, rows in tables.items()
        }

    def _fused_sessions(self) -> pd.DataFrame:
        """As good as odometry can be, but that `raw` never answers in walk_4."""
        rows = []
        for model, (method, options, *_), session in product(self.models, METHODS, ("walk_3", "walk_4")):
            never = method == "raw" and session == "walk_4"
            row: dict[str, object] = {"method": method, "options": options, "model": model, "scene": self.name}
            row |= {
                "session_id": session,
                "split": "test",
                "frames": 30,
                "answered": 0 if never else 27,
                "first_fix_s": None if never else 3.0,
            }
            row |= {"longest_outage_s": None if never else 4.25, "jitter_m": 0.125, "jitter_deg": 0.75}
            rows.append(row | {"recovery_s": np.inf if method == "paper_rule" else None})
        return pd.DataFrame(rows)

    def _sweep(self) -> pd.DataFrame:
        """The larger a threshold, the larger errors and coverage."""
        values = {"n": (1, 2, 3), "d_th_m": (0.2, 0.4, 0.8), "o_th_deg": (2.0, 4.0, 8.0), "gamma": (0.95, 0.99, 0.999)}
        usual = {"n": 2, "d_th_m": 0.4, "o_th_deg": 4.0, "gamma": 0.99}
        figures = {c.name: 10.0 for c in schema("fuse", "sweep").columns if c.dtype == "float64"}
        counts = {"frames": 40, "answered": 30, "total": 40, "too_uncertain": 0}
        rows = [
            figures | counts | usual | {"scene": self.name, "model": model, "varied": varied, varied: value}
            | {"subset": subset, "position_mean_m": 1.0 + i, "rotation_mean_deg": 3.0 + i, "coverage_pct": 60.0 + i}
            for model in self.models
            for varied, tried in values.items()
            for i, value in enumerate(tried)
            for subset in ("rp+opt", "all")
        ]  # fmt: skip
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
        rows = []
        for session, of_session in self.frames.groupby("session_id"):
            n = len(of_session)
            row = {
                "session_id": session,
                "recording": session,
                "format": "3d_scanner_app",
                "device": "made up",
                "clock": "boot",
            }
            split = of_session["split"].iloc[-1].replace("val", "train")
            rows.append(
                row
                | {
                    "duration_s": n - 1.0,
                    "path_m": 110.0,
                    "poses": n,
                    "images": n,
                    "frames": n,
                    "support_frames": 0,
                    "pose_source": "vio",
                    "reference_unit": None,
                    "up": "+y",
                    "up_source": "format",
                    **dict.fromkeys(f"reference_origin_{axis}" for axis in "xyz"),
                    "appearance": self.appearances.get(str(session), "same"),
                    "split": split,
                }
            )
        return pd.DataFrame(rows)

    def _rejects(self) -> pd.DataFrame:
        rows = [
            ("walk_1", "frame_00007.json", "image is broken: truncated after 20 bytes", "image"),
            ("walk_1", "frame_00008.json", "image is broken: truncated after 7 bytes", "image"),
            ("walk_1", "frame_00009.json", "not tracking", "pose"),
            ("walk_2", "depth_00003.png", "depth image is broken; its image is used without", "depth"),
            ("walk_2", "frame_00004.json", "no number", None),
        ]
        table = pd.DataFrame(rows, columns=["session_id", "source", "reason", "rejected"])
        return table.assign(t_ns=pd.array([None] * len(rows), dtype="Int64"))

    def _images(self, lost: int) -> pd.DataFrame:
        count = len(self.frames)
        poses = self.map_T_cam.copy()
        poses[lost] = np.nan
        registered = np.arange(count) != lost
        images = pd.concat([self.frames[["frame_id"]], pose_frame("sfm_cam", poses)], axis=1).assign(
            registered=registered, not_registered=cells(None if r else NotRegistered.NOT_MAPPED for r in registered),
            model_id="incremental/0", keypoints=900, covariance=None, motion_sd=np.nan,
            observations=self.rng.integers(150, 700, count) * registered,
            reprojection_px=np.where(registered, self.rng.gamma(20, 0.04, count), np.nan),
            track_length=np.where(registered, 6.5, np.nan), triangulation_deg=np.where(registered, 12.0, np.nan),
            held_out_matches=40, held_out_px=np.where(registered, 0.5, np.nan),
            fitted_px=np.where(registered, 0.4, np.nan), fx=480.0, fy=480.0, cx=320.0, cy=240.0,
            distortion=cells([[0.09, -0.12, 0.0, 0.0]] * count), readout_s=0.015, camera_origin="estimated",
            **dict.fromkeys((f"{what}_{a}" for what in ("angular", "velocity") for a in "xyz"), 0.0),
        )  # fmt: skip
        support = images.iloc[[lost]].assign(frame_id="walk_1/000900")
        return pd.concat([images, support], ignore_index=True)

    def _aligned(self) -> pd.DataFrame:
        sessions = self.frames.groupby("session_id").size().index
        frame = pd.DataFrame({"session_id": sessions, "segment": 0})
        for column in schema("align", "sessions").columns:
            if column.name not in frame and not column.name.startswith("map_vio"):
                plain: Any = {"int64": 30, "string": "vio", "float64": 0.021}[column.dtype]
                frame[column.name] = 1.003 if column.name == "scale" else plain
        frame["t_start_ns"], frame["t_end_ns"] = 0, 10**15
        identity = np.tile(np.eye(4), (len(frame), 1, 1))
        return pd.concat([frame, pose_frame("map_vio", identity), pose_frame("map_vio_yaw", identity)], axis=1)

    def _residuals(self, lost: int) -> pd.DataFrame:
        """VIO moves away by a millimetre a frame."""
        frames = self.frames.drop(columns="split")
        count = frames.groupby("session_id").cumcount()
        errors = {
            f"{window}{name}": 0.001 * count for window in ("", "window_") for name in ("position_m", "rotation_deg")
        }
        return frames.assign(segment=0, component=0, travelled_m=0.5 * count, **errors).drop(index=lost)

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
        row = {"check": "window_position", "session_id": "walk_1", "t_start_ns": 0, "t_end_ns": SECOND, "frames": 10}
        row |= {"value": 0.01, "limit": 0.1, "unit": "m", "sd": None, "status": "passed", "reason": ""}
        row |= {"advice": "", "component": 0, "cause": None}
        failed = row | {
            "session_id": "walk_2",
            "value": 0.3,
            "status": "failed",
            "reason": "pose in SfM inconsistent with VIO",
        }
        undecided = failed | {"check": "ruler_scale", "value": None, "limit": 0.03, "status": "undecided"}
        undecided["reason"] = "board: seen once"
        return pd.DataFrame([row, failed, undecided])

    def _history(self) -> pd.DataFrame:
        rows = []
        for model in MODELS:
            for epoch in range(1, 13):
                row = {
                    "model": model,
                    "scenes": [self.name],
                    "epoch": epoch,
                    "learning_rate": 1e-4,
                    "selected": epoch == 11,
                }
                row |= {"train_loss": 3 / epoch - 1, "val_position_m": 6 / epoch, "val_rotation_deg": 30 / epoch}
                rows.append(row | {"sx": 0.0, "sq": -3.0, "seconds": 2.0})
        return pd.DataFrame(rows)

    def _cards(self) -> pd.DataFrame:
        base = {
            "scenes": [self.name],
            "weights": "scratch: no internet",
            "resize_px": 256,
            "crop_px": 224,
            "width_px": 224,
            "upright": False,
            "focal_px": 250.0,
            "epochs": 12,
        }
        base |= {
            "train_frames": 108,
            "val_frames": 12,
            "best_epoch": 11,
            "seed": 0,
            "config": "{}",
            "inference_ms": 12.0,
        }
        base |= {"device": "made-up processor, float32", "train_seconds": 61.0}
        pn = {
            "model": "PN",
            "label": "PN",
            "file": "pn.pt",
            "parameters": 22_349_000,
            "bytes": 89_430_000,
            "layers": "",
            "reduced": "",
        }
        mst = {
            "model": "MS-T",
            "label": "MS-T",
            "file": "mst.pt",
            "parameters": 18_000_000,
            "bytes": 60_000_000,
            "layers": "2+2 layers",
        }
        return pd.DataFrame([base | pn, base | mst | {"reduced": "2+2 instead of 6+6 transformer layers"}])


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
        folders = [data.run("tiny", member, stage) for member in members]
        return pd.concat([read_table(f / f"{table}.parquet", schema(stage, table)) for f in folders], ignore_index=True)

    train = {table: joined("train", table) for table in ("predictions", "history", "models")}
    train = {table: frame[frame["model"] == "MS-T"] for table, frame in train.items()}
    for table in ("history", "models"):
        train[table] = train[table].drop_duplicates("epoch" if table == "history" else "model").copy()
        train[table]["scenes"] = [members] * len(train[table])
    errors = joined("fuse", "errors")
    columns = [c for c in errors.columns if c.endswith(("position_m", "rotation_deg"))]
    errors.loc[errors["model"] == "MS-T", columns] *= 0.5
    write_stage(data, name, "train", train, True)
    fused = {table: joined("fuse", table) for table in ("poses", "sweep", "intervals", "sessions")}
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
