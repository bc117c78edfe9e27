"""Figures of one real capture: what our stages and stock COLMAP made of the same images, and both against VIO."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.stages import Cost
from benchmarks.stock import largest_model, matcher_name
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array, rotation_angle
from groundwalk.scoring.errors import relative_error
from groundwalk.sfm.database import image_id
from groundwalk.sfm.model import load_models
from groundwalk.store import DataRoot
from groundwalk.store.manifests import MANIFEST, load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table

OURS, STOCK, RATIO, VIO_WAY = "ours", "stock", "ours / stock", "VIO"
PASSED, REFUSED, CRASHED = "passed", "refused", "crashed"
STAGES = {"import": "groundwalk.capture_import", "sfm": "groundwalk.sfm", "align": "groundwalk.alignment"}
_FEWEST_COMPARED = 5
_STRETCHES = 8  # of the walk, each left out once: errors of neighbours hang together
POSITION = "common frames against VIO, position RMS"
# A UserError ends a command with this.
_REFUSAL = 2


@dataclass(frozen=True)
class Figure:
    """One number: whose (`way`: ours, stock, or their ratio), of what (`subject`: a session, a lens; empty: the whole
    capture), its name and unit."""

    name: str
    value: float
    unit: str = ""
    way: str = OURS
    subject: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whether there is ground truth, and, where there isn't, which stage ended with what."""

    outcome: str
    stage: str = ""
    cause: str = ""

    def __str__(self) -> str:
        return self.outcome if self.outcome == PASSED else f"{self.outcome} by {self.stage}: {self.cause}"


@dataclass(frozen=True)
class Finished:
    """A capture after import, sfm, align and stock COLMAP: where their outputs are, what each cost, and the verdict."""

    scene: str
    profile: str
    root: DataRoot
    stock_folder: Path
    costs: dict[str, Cost]
    verdict: Verdict

    def folder(self, stage: str) -> Path:
        """The stage's artefact; of a stage that refused its input, what it left."""
        finished = self.root.run(self.profile, self.scene, stage)
        return finished if (finished / MANIFEST).is_file() else finished.with_name(f".{stage}.partial")

    def has(self, stage: str) -> bool:
        """Whether the stage finished."""
        return (self.root.run(self.profile, self.scene, stage) / MANIFEST).is_file()

    def table(self, stage: str, name: str) -> pd.DataFrame:
        """One of the stage's tables."""
        return read_table(self.folder(stage) / f"{name}.parquet", schema(stage, name))

    def has_table(self, stage: str, name: str) -> bool:
        """Whether the stage wrote it: align also writes its checks where it refuses the model."""
        return (self.folder(stage) / f"{name}.parquet").is_file()

    def map_T_cam(self) -> Array:
        """Ground truth of import's frames (N, 4, 4), NaN where there is none."""
        frames, truth = self.table("import", "frames"), self.table("align", "ground_truth")
        return poses_of(truth.set_index("frame_id").reindex(frames["frame_id"]).reset_index(), "map_cam")

    def figures(self, stage: str) -> dict[str, float]:
        """The figures of the stage's manifest that are numbers; none where it didn't finish."""
        if not self.has(stage):
            return {}
        values = load_manifest(self.folder(stage))["figures"]
        return {name: float(value) for name, value in values.items() if isinstance(value, int | float)}


@dataclass(frozen=True)
class Placed:
    """Camera poses of one way, each session of each model fitted to the session's VIO: by a Sim3 of positions, and by
    a mean rotation for rotations, which a straight path leaves open. N frames; NaN where there is nothing to fit."""

    xyz_vio: Array
    """(N, 3) in the session's VIO frame, metres."""
    position_m: Array
    """(N,)"""
    rotation_deg: Array
    """(N,)"""
    step_m: Array
    """(N,) of the motion to the frame from the one before in its group: a drift of VIO hardly shows in it"""
    step_deg: Array
    """(N,)"""


def rows_in_time(frames: pd.DataFrame, usable_N: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The usable rows of import's frames, in order of time."""
    rows = np.flatnonzero(usable_N)
    return rows[np.argsort(frames["t_ns"].to_numpy(np.int64)[rows], kind="stable")]


def verdict_of(statuses: dict[str, int], logs: dict[str, str], causes: list[str]) -> Verdict:
    """The verdict from each stage's exit status, in order, and what it printed; `causes` are the names of align's
    failed checks, the one that says most first."""
    for stage, status in statuses.items():
        if status == 0:
            continue
        lines = logs[stage].splitlines()
        message = next((line.removeprefix("error: ") for line in lines if line.startswith("error: ")), "")
        outcome = REFUSED if status == _REFUSAL else CRASHED
        if stage == "align" and causes:
            return Verdict(outcome, stage, causes[0])
        return Verdict(outcome, stage, message or (lines[-1] if lines else f"exit status {status}"))
    return Verdict(PASSED)


def place(vio_T_cam: Array, sfm_T_cam: Array, group: NDArray[np.object_]) -> Placed:
    """Fit the poses (N, 4, 4) of each group (N,), a session in a model in order of time, to VIO's; None: in no group.

    Groups of fewer than five frames with VIO, or of positions on a line, aren't fitted.
    """
    count = len(group)
    placed = Placed(np.full((count, 3), np.nan), *(np.full(count, np.nan) for _ in range(4)))
    usable = np.isfinite(vio_T_cam[:, 0, 0]) & np.isfinite(sfm_T_cam[:, 0, 0]) & ~pd.isna(group)
    for name in pd.unique(group[usable]):
        rows = np.flatnonzero(usable & (group == name))
        if len(rows) < _FEWEST_COMPARED:
            continue
        vio, sfm = vio_T_cam[rows], sfm_T_cam[rows]
        try:
            fit = fit_sim3(vio[:, :3, 3], sfm[:, :3, 3])
        except GeometryError:
            continue
        placed.xyz_vio[rows] = fit.points(sfm[:, :3, 3])
        placed.position_m[rows] = pose_residuals(vio, fit.poses(sfm), np.eye(4))[0]
        placed.step_m[rows[1:]], placed.step_deg[rows[1:]] = relative_error(vio, fit.poses(sfm))
        vio_R_sfm = Rotation.from_matrix(vio[:, :3, :3] @ np.swapaxes(sfm[:, :3, :3], 1, 2)).mean().as_matrix()
        left = np.swapaxes(vio[:, :3, :3], 1, 2) @ vio_R_sfm @ sfm[:, :3, :3]
        placed.rotation_deg[rows] = np.degrees(rotation_angle(left))
    return placed


@dataclass(frozen=True)
class Paths:
    """The dataset's frames, session by session in time: poses by VIO, ours and stock; each one's model, -1: none."""

    session: NDArray[np.object_]
    t_ns: NDArray[np.int64]
    vio_T_cam: Array
    ours_T_cam: Array
    ours_model: NDArray[np.int64]
    stock_T_cam: Array
    stock_model: NDArray[np.int64]

    def groups(self, *, ours: bool, stock: bool) -> NDArray[np.object_]:
        """The session and model of each frame that these ways have, None for others (N,)."""
        known = np.ones(len(self.session), bool)
        names = self.session.astype(str)
        for wanted, model in ((ours, self.ours_model), (stock, self.stock_model)):
            if wanted:
                known &= model >= 0
                names = np.char.add(np.char.add(names, "|"), model.astype(str))
        return np.array([name if there else None for name, there in zip(names, known, strict=True)], dtype=object)


def paths_of(run: Finished) -> Paths:
    """Ours are SfM's poses of the frames that have ground truth, or that are registered where align refused the
    model: ground truth is SfM's poses moved by a similarity."""
    frames = run.table("import", "frames")
    count = len(frames)
    ours_T_cam, ours_model = np.full((count, 4, 4), np.nan), np.full(count, -1)
    if run.has("sfm"):
        images = run.table("sfm", "images")
        ours_T_cam, ours_model = poses_of(images, "sfm_cam"), pd.factorize(images["model_id"])[0]
    if run.has("align"):
        truth = run.table("align", "ground_truth").set_index("frame_id")["quality"]
        refused = frames["frame_id"].map(truth).fillna("none").to_numpy() == "none"
        ours_model = np.where(refused, -1, ours_model)
    stock_T_cam, stock_model = np.full((count, 4, 4), np.nan), np.full(count, -1)
    if (largest := largest_model(run.stock_folder)) is not None:
        model = load_models([largest], count)
        stock_T_cam, stock_model = model.sfm_T_cam, model.model
    session, t_ns = frames["session_id"].to_numpy(object), frames["t_ns"].to_numpy(np.int64)
    rows = np.lexsort([t_ns, session.astype(str)])
    rows = rows[~frames["support"].to_numpy(bool)[rows]]
    vio = poses_of(frames, "vio_cam")
    return Paths(session[rows], t_ns[rows], vio[rows], *(
        values[rows] for values in (ours_T_cam, ours_model, stock_T_cam, stock_model)
    ))  # fmt: skip


def placed_alone(paths: Paths) -> tuple[Placed, Placed]:
    """Our frames and stock's, each fitted by itself."""
    return (
        place(paths.vio_T_cam, paths.ours_T_cam, paths.groups(ours=True, stock=False)),
        place(paths.vio_T_cam, paths.stock_T_cam, paths.groups(ours=False, stock=True)),
    )


def ground_truth_figures(run: Finished) -> list[Figure]:
    """The verdict, frames, classes, models, checks, reprojection and held-out errors; stock's where it has them."""
    frames = run.table("import", "frames")
    dataset = int((~frames["support"]).sum())
    figures = [
        Figure("accepted", float(run.verdict.outcome == PASSED)),
        Figure("images", len(frames)),
        Figure("frames", dataset),
        Figure("support frames", len(frames) - dataset),
    ]
    if run.has("sfm"):
        sfm = run.figures("sfm")
        figures += [
            Figure("images registered", sfm["registered"]),
            Figure("share of images registered", 100 * sfm["registered"] / len(frames), "%"),
            Figure("models", sfm["models"]),
            Figure("reprojection error, mean", sfm["mean_reprojection_px"], "px"),
            Figure("held-out error, median", sfm["held_out_px"], "px"),
            Figure("fitted error, median", sfm["fitted_px"], "px"),
        ]
    align = run.figures("align")
    for name, key, unit, factor in (
        ("frames registered", "registered", "", 1),
        ("frames with ground truth", "with_ground_truth", "", 1),
        *((f"class {quality}", f"quality_{quality}", "", 1) for quality in "ABC"),
        ("scale, one sigma", "scale_sd", "%", 100),
        ("vertical, one sigma", "vertical_sd_deg", "deg", 1),
    ):
        if align.get(key) is not None:
            figures.append(Figure(name, factor * align[key], unit))
    if align:
        figures.append(Figure("class A or B", align["quality_A"] + align["quality_B"]))
    if run.has_table("align", "checks"):
        checks = run.table("align", "checks")
        figures += [Figure("checks", len(checks)), Figure("checks failed", int((checks["status"] == "failed").sum()))]
        windows = checks.loc[checks["check"] == "window_position", "value"].max()
        if np.isfinite(windows):
            figures.append(Figure("largest residual to VIO in a window", windows, "m"))
    return figures + _stock_model_figures(run, len(frames))


def _stock_model_figures(run: Finished, images: int) -> list[Figure]:
    pairs = images * (images - 1) / 2 if matcher_name(images) == "exhaustive" else np.nan
    models = len(list(run.stock_folder.glob("[0-9]*")))
    figures = [Figure("models", models, way=STOCK), Figure("pairs", pairs, way=STOCK)]
    if (largest := largest_model(run.stock_folder)) is None:
        return figures
    model = load_models([largest], images)
    return [
        *figures,
        Figure("images registered", int(model.registered.sum()), way=STOCK),
        Figure("share of images registered", 100 * float(model.registered.mean()), "%", STOCK),
        Figure("reprojection error, mean", float(np.linalg.norm(model.residual_px, axis=1).mean()), "px", STOCK),
    ]


def camera_figures(run: Finished) -> list[Figure]:
    """Distortion and readout time of each lens and each session's focal scale, of all our models, as one lens should
    be the same in each, and of stock's largest."""
    figures = list[Figure]()
    if run.has("sfm"):
        lenses, sessions = run.table("sfm", "lenses"), run.table("sfm", "intrinsics")
        for number, model_id in enumerate(lenses["model_id"].unique()):
            of_model = f", model {number + 1}" if number else ""
            for lens in lenses[lenses["model_id"] == model_id].to_dict("records"):
                subject = lens["lens_id"] + of_model
                for name in ("k1", "k2", "k3"):
                    figures += with_sigma(name, lens[name], lens[f"{name}_sd"], "", subject)
                figures += with_sigma("readout", 1000 * lens["readout_s"], 1000 * lens["readout_sd_s"], "ms", subject)
            for session in sessions[sessions["model_id"] == model_id].to_dict("records"):
                subject = session["session_id"] + of_model
                figures += with_sigma("focal scale", session["focal_scale"], session["focal_scale_sd"], "", subject)
    return figures + _stock_camera_figures(run)


def with_sigma(name: str, value: float, sigma: float, unit: str, subject: str) -> list[Figure]:
    """An estimate and its standard error."""
    return [Figure(name, value, unit, subject=subject), Figure(f"{name}, one sigma", sigma, unit, subject=subject)]


def _stock_camera_figures(run: Finished) -> list[Figure]:
    """The refined camera of each session, its focal length against the median of the logged ones."""
    if (largest := largest_model(run.stock_folder)) is None:
        return []
    reconstruction, frames = pycolmap.Reconstruction(largest), run.table("import", "frames")
    figures = []
    for session, rows in frames.groupby("session_id", sort=True):
        row = next((row for row in rows.index if reconstruction.exists_image(image_id(int(row)))), None)
        if row is None:
            continue
        camera = reconstruction.image(image_id(int(row))).camera
        assert camera is not None
        logged = rows[(rows["width"] == camera.width) & (rows["height"] == camera.height)][["fx", "fy"]].median()
        scale = float(np.sqrt(camera.params[0] * camera.params[1] / (logged["fx"] * logged["fy"])))
        for name, value in (("k1", camera.params[4]), ("k2", camera.params[5]), ("focal scale", scale)):
            figures.append(Figure(name, float(value), way=STOCK, subject=str(session)))
    return figures


def agreement_figures(run: Finished) -> list[Figure]:
    """Agreement with VIO on the frames that both ways have, each way fitted in the same groups; and of each way on all
    of its frames: a model that is folded may be right on those that both have."""
    paths = paths_of(run)
    ours, stock = placed_alone(paths)
    figures = _agreement(paths, ours, "all") + _agreement(paths, stock, "all", STOCK)
    both = paths.groups(ours=True, stock=True)
    ours, stock = (place(paths.vio_T_cam, poses, both) for poses in (paths.ours_T_cam, paths.stock_T_cam))
    by_way = {OURS: _agreement(paths, ours, "common"), STOCK: _agreement(paths, stock, "common", STOCK)}
    figures += by_way[OURS] + by_way[STOCK]
    for a, b in zip(by_way[OURS], by_way[STOCK], strict=True):
        if a.unit:
            figures.append(Figure(a.name, a.value / b.value if b.value else np.nan, "", RATIO, a.subject))
    return figures + three_way_figures(paths)


def three_way_figures(paths: Paths) -> list[Figure]:
    """Positions of ours, stock and VIO against each other: how far ours and stock are apart, what of their residuals is
    VIO's where errors of the three are independent (a three-cornered hat: Gray and Allan, 28th Annual Symposium on
    Frequency Control, 1974), and one sigma of the residuals and their ratio, by a jackknife over stretches of each
    session (Künsch, Annals of Statistics 17, 1989)."""
    both = paths.groups(ours=True, stock=True)
    names = ["", *np.unique(paths.session.astype(str))]

    def rms_mm(left_out: NDArray[np.bool_]) -> Array:
        """Of each session: ours to VIO, stock to VIO, ours to stock (S, 3)."""
        group = both.copy()
        group[left_out] = None
        ours, stock = (place(paths.vio_T_cam, poses, group) for poses in (paths.ours_T_cam, paths.stock_T_cam))
        apart_m = np.linalg.norm(ours.xyz_vio - stock.xyz_vio, axis=1)
        all_m = np.stack([ours.position_m, stock.position_m, apart_m], axis=1)
        of = [np.isfinite(apart_m) & ((paths.session == name) | (name == "")) for name in names]
        return np.array(
            [1000 * np.sqrt(np.mean(all_m[rows] ** 2, axis=0)) if rows.any() else [np.nan] * 3 for rows in of]
        )

    whole = rms_mm(np.zeros(len(both), bool))
    stretch = np.concatenate(
        [np.arange(count) * _STRETCHES // count for count in pd.Series(paths.session).groupby(paths.session).size()]
    )
    resampled = np.array([rms_mm(stretch == k) for k in range(_STRETCHES)])
    resampled = np.concatenate([resampled, resampled[..., :1] / resampled[..., 1:2]], axis=2)
    sigma = np.sqrt((_STRETCHES - 1) * np.var(resampled, axis=0))
    figures = []
    for name, (ours, stock, apart), sd in zip(names, whole, sigma, strict=True):
        if np.isfinite(apart):
            figures += [
                Figure(f"{POSITION}, one sigma", sd[0], "mm", OURS, name),
                Figure(f"{POSITION}, one sigma", sd[1], "mm", STOCK, name),
                Figure(f"{POSITION}, one sigma", sd[3], "", RATIO, name),
                Figure("ours and stock apart, position RMS", apart, "mm", subject=name),
            ]
            if apart < min(ours, stock):
                of_vio = np.sqrt((ours**2 + stock**2 - apart**2) / 2)
                figures.append(Figure("VIO's part of the residuals, position RMS", of_vio, "mm", subject=name))
    return figures


def _agreement(paths: Paths, placed: Placed, which: str, way: str = OURS) -> list[Figure]:
    figures = []
    for session in ["", *np.unique(paths.session.astype(str))]:
        rows = np.isfinite(placed.position_m) & ((paths.session == session) | (session == ""))
        if not rows.any():
            continue
        name = f"{which} frames against VIO"
        figures.append(Figure(name, int(rows.sum()), "", way, session))
        for statistic, value, unit in (
            ("position RMS", 1000 * _rms(placed.position_m[rows]), "mm"),
            ("rotation median", float(np.median(placed.rotation_deg[rows])), "deg"),
            ("step RMS", 1000 * _rms(placed.step_m[rows]), "mm"),
            ("step rotation RMS", _rms(placed.step_deg[rows]), "deg"),
        ):
            figures.append(Figure(f"{name}, {statistic}", value, unit, way, session))
    return figures


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def cost_figures(run: Finished) -> list[Figure]:
    """Wall and processor seconds and peak memory of each stage, of ours together, of stock, and the ratios."""
    total = total_cost([run.costs[stage] for stage in STAGES if stage in run.costs])
    figures = [
        figure
        for subject, cost in (*((stage, run.costs[stage]) for stage in STAGES if stage in run.costs), ("", total))
        for figure in _cost(cost, OURS, subject)
    ]
    if (stock := run.costs.get(STOCK)) is None:
        return figures
    return [
        *figures,
        *_cost(stock, STOCK, ""),
        *(
            Figure(ours.name, ours.value / other.value, "", RATIO)
            for ours, other in zip(_cost(total, OURS, ""), _cost(stock, STOCK, ""), strict=True)
        ),
    ]


def total_cost(costs: list[Cost]) -> Cost:
    """Of processes that ran one after the other."""
    return Cost(
        sum(c.wall_s for c in costs),
        sum(c.cpu_s for c in costs),
        max((c.peak_mib for c in costs), default=0.0),
        sum(c.written_mib for c in costs),
    )


def _cost(cost: Cost, way: str, subject: str) -> list[Figure]:
    return [
        Figure("wall", cost.wall_s, "s", way, subject),
        Figure("processor", cost.cpu_s, "s", way, subject),
        Figure("peak memory", cost.peak_mib, "MiB", way, subject),
    ]


PARTS: tuple[Callable[[Finished], list[Figure]], ...] = (
    ground_truth_figures,
    camera_figures,
    agreement_figures,
    cost_figures,
)


def figures_of(run: Finished) -> list[Figure]:
    """All figures of a capture; verdict and costs alone where import already refused it."""
    if not run.has("import"):
        return [Figure("accepted", 0.0), *cost_figures(run)]
    return [figure for part in PARTS for figure in part(run)]
