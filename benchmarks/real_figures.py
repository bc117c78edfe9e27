"""A run of a real capture by our stages and stock COLMAP, and its figures: both against VIO, and VIO against rulers."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.cost import Cost, run_timed
from benchmarks.stock import Pairs, largest_model, pairs_of
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array, rotation_angle
from groundwalk.reports.verdict import state_of
from groundwalk.scoring.errors import relative_error
from groundwalk.sfm.database import image_id
from groundwalk.sfm.model import Model, load_models
from groundwalk.store import DataRoot
from groundwalk.store.choices import FailureCause, RulerPart
from groundwalk.store.manifests import MANIFEST, load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table

OURS, STOCK, RATIO, VIO_WAY = "ours", "stock", "ours / stock", "VIO"
DONE, REFUSED, CRASHED = "ground truth", "refused", "crashed"
STAGES = {"import": "groundwalk.capture_import", "sfm": "groundwalk.sfm", "align": "groundwalk.alignment"}
COMMON, ALL = "common frames against VIO", "all frames against VIO"
POSITION, APART = f"{COMMON}, position RMS", "ours and stock apart, position RMS"
VIOS_PART = "VIO's part of the residuals, position RMS"
BOARD = "VIO's scale against the board"
BOUNDS, WITHIN_BOUNDS = f"{BOARD}, 95 % bounds", f"{BOARD}, share of its 95 % bounds"
HELD_OUT, HELD_OUT_RMS = "board's scale against its held-out corners", "held-out corners, RMS"
DEPTH = "depth by the sensor over the map's"
CONFIDENCES = ("any", "low", "medium", "high")
_FEWEST_COMPARED = 5
_STRETCHES = 8  # of the walk, each left out once: errors of neighbours hang together
_REFUSAL = 2  # a UserError ends a command with this
_SIGMAS = 1.96
_MIN_POINTS = 100  # the standard error of fewer isn't known


@dataclass(frozen=True)
class Figure:
    """One number: whose (`way`: ours, stock, or their ratio), of what (`subject`: a session, a lens; empty: the whole
    capture), its name and unit."""

    name: str
    value: float
    unit: str = ""
    way: str = OURS
    subject: str = ""


@dataclass
class Run:
    """A capture after import, sfm, align and stock COLMAP: where their outputs are, what each cost, and the outcome:
    ground truth, or which stage ended with what."""

    scene: str
    root: DataRoot
    stock_folder: Path
    profile: str = "demo"
    costs: dict[str, Cost] = field(default_factory=dict)
    outcome: str = DONE

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

    @property
    def verdict(self) -> str:
        """As the report's page has it; of a capture without ground truth its outcome."""
        if not self.has("align"):
            return self.outcome
        return state_of(self.table("align", "checks"), self.table("align", "ground_truth")["quality"])[0].value

    def manifest(self, stage: str) -> dict[str, Any]:
        """A finished stage's manifest."""
        return load_manifest(self.folder(stage))

    def map_T_cam(self) -> Array:
        """Ground truth of import's frames (N, 4, 4), NaN where there is none."""
        frames, truth = self.table("import", "frames"), self.table("align", "ground_truth")
        return poses_of(truth.set_index("frame_id").reindex(frames["frame_id"]).reset_index(), "map_cam")

    def stock_model(self, images: int) -> Model | None:
        """Stock COLMAP's largest model of so many images; None where it has none."""
        largest = largest_model(self.stock_folder)
        return None if largest is None else load_models([largest], images)


def run_stages(scene: str, capture: Path, folder: Path, import_settings: Sequence[str] = (), seed: int = 0) -> Run:
    """Import, sfm and align of a capture in an empty folder, each a process of its own, until one refuses its input.
    What they print is in `<stage>.log`."""
    run = Run(scene, DataRoot(folder / "data"), folder / "stock")
    captures = run.root.captures(scene)
    captures.parent.mkdir(parents=True, exist_ok=True)
    captures.symlink_to(capture.resolve(), target_is_directory=True)
    for stage in STAGES:
        log = run.root.root / f"{stage}.log"
        status, run.costs[stage] = run_stage(run, stage, log, seed, import_settings if stage == "import" else ())
        if status:
            run.outcome = _outcome(run, stage, status, log.read_text(encoding="utf-8", errors="replace"))
            break
    return run


def run_stage(run: Run, stage: str, log: Path, seed: int = 0, settings: Sequence[str] = ()) -> tuple[int, Cost]:
    """Exit status and cost of a stage."""
    command = [sys.executable, "-m", STAGES[stage], "--scene", run.scene, "--profile", run.profile]
    command += ["--data", str(run.root.root), "--seed", str(seed)]
    command += [word for setting in settings for word in ("--set", setting)]
    return run_timed(command, run.root.run(run.profile, run.scene, stage), log)


def _outcome(run: Run, stage: str, status: int, printed: str) -> str:
    """By a stage that failed: the cause that says most of align's failed checks, or else the error that it printed."""
    outcome = f"{REFUSED if status == _REFUSAL else CRASHED} by {stage}"
    if stage == "align" and run.has_table("align", "checks"):
        checks = run.table("align", "checks")
        causes = set(checks.loc[checks["status"] == "failed", "cause"])
        if causes:
            return f"{outcome}: {next(cause for cause in FailureCause if cause in causes)}"
    lines = printed.splitlines() or [f"exit status {status}"]
    message = next((line.removeprefix("error: ") for line in lines if line.startswith("error: ")), lines[-1])
    return f"{outcome}: {message}"


def figures_of(run: Run) -> list[Figure]:
    """All figures of a capture; costs alone where import already refused it."""
    if not run.has("import"):
        return _cost_figures(run)
    parts = (_ground_truth_figures, _camera_figures, _agreement_figures, _cost_figures)
    return [figure for part in parts for figure in part(run)]


def _ground_truth_figures(run: Run) -> list[Figure]:
    """Frames, classes, models, checks, reprojection and held-out errors; stock's where it has them."""
    images = run.table("import", "frames")
    dataset = int((~images["support"]).sum())
    figures = [Figure("images", len(images)), Figure("frames", dataset)]
    figures.append(Figure("support frames", len(images) - dataset))
    for stage, rows in _OF_MANIFESTS.items():
        values = run.manifest(stage)["figures"] if run.has(stage) else {}
        figures += [Figure(name, by * values[key], unit) for name, key, unit, by in rows if values.get(key) is not None]
        if stage == "sfm" and values:
            figures.append(Figure("share of images registered", 100 * values["registered"] / len(images), "%"))
        if stage == "align" and values:
            figures.append(Figure("class A or B", values["quality_A"] + values["quality_B"]))
    if run.has_table("align", "checks"):
        checks = run.table("align", "checks")
        figures += [Figure("checks", len(checks)), Figure("checks failed", int((checks["status"] == "failed").sum()))]
        windows = checks.loc[checks["check"] == "window_position", "value"].max()
        if np.isfinite(windows):
            figures.append(Figure("largest residual to VIO in a window", windows, "m"))
    pairs = len(images) * (len(images) - 1) / 2 if pairs_of(len(images)) == Pairs.EXHAUSTIVE else np.nan
    models = len(list(run.stock_folder.glob("[0-9]*")))
    figures += [Figure("models", models, way=STOCK), Figure("pairs", pairs, way=STOCK)]
    if (model := run.stock_model(len(images))) is not None:
        figures += [
            Figure("images registered", int(model.registered.sum()), way=STOCK),
            Figure("share of images registered", 100 * float(model.registered.mean()), "%", STOCK),
            Figure("reprojection error, mean", model.mean_error_px, "px", STOCK),
        ]
    return figures


# Name, key in the manifest, unit and factor.
_OF_MANIFESTS = {
    "sfm": (
        ("images registered", "registered", "", 1),
        ("models", "models", "", 1),
        ("reprojection error, mean", "mean_reprojection_px", "px", 1),
        ("held-out error, median", "held_out_px", "px", 1),
        ("fitted error, median", "fitted_px", "px", 1),
    ),
    "align": (
        ("frames registered", "registered", "", 1),
        ("frames with ground truth", "with_ground_truth", "", 1),
        *((f"class {quality}", f"quality_{quality}", "", 1) for quality in "ABC"),
        ("scale, one sigma", "scale_sd", "%", 100),
        ("vertical, one sigma", "vertical_sd_deg", "deg", 1),
    ),
}


def _camera_figures(run: Run) -> list[Figure]:
    """Distortion and readout time of each lens and each session's focal scale, of all our models, as one lens should
    be the same in each; and of stock's largest, its focal length against the median of the logged ones."""
    figures = list[Figure]()
    for table, key in (("lenses", "lens_id"), ("intrinsics", "session_id")) if run.has("sfm") else ():
        rows = run.table("sfm", table)
        number = pd.factorize(rows["model_id"])[0]
        for model, row in zip(number, rows.to_dict("records"), strict=True):
            subject = row[key] + (f", model {model + 1}" if model else "")
            if table == "lenses":
                for name in ("k1", "k2", "k3"):
                    figures += _with_sigma(name, row[name], row[f"{name}_sd"], "", subject)
                figures += _with_sigma("readout", 1000 * row["readout_s"], 1000 * row["readout_sd_s"], "ms", subject)
            else:
                figures += _with_sigma("focal scale", row["focal_scale"], row["focal_scale_sd"], "", subject)
    if (largest := largest_model(run.stock_folder)) is None:
        return figures
    reconstruction = pycolmap.Reconstruction(largest)
    for session, rows in run.table("import", "frames").groupby("session_id", sort=True):
        registered = [row for row in rows.index if reconstruction.exists_image(image_id(int(row)))]
        if not registered:
            continue
        camera = reconstruction.image(image_id(int(registered[0]))).camera
        assert camera is not None
        logged = rows[(rows["width"] == camera.width) & (rows["height"] == camera.height)][["fx", "fy"]].median()
        scale = float(np.sqrt(camera.params[0] * camera.params[1] / (logged["fx"] * logged["fy"])))
        for name, value in (("k1", camera.params[4]), ("k2", camera.params[5]), ("focal scale", scale)):
            figures.append(Figure(name, float(value), way=STOCK, subject=str(session)))
    return figures


def _with_sigma(name: str, value: float, sigma: float, unit: str, subject: str) -> list[Figure]:
    """An estimate and its standard error."""
    return [Figure(name, value, unit, subject=subject), Figure(f"{name}, one sigma", sigma, unit, subject=subject)]


def rows_in_time(frames: pd.DataFrame, usable_N: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The usable rows of import's frames, in order of time."""
    rows = np.flatnonzero(usable_N)
    return rows[np.argsort(frames["t_ns"].to_numpy(np.int64)[rows], kind="stable")]


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


def paths_of(run: Run) -> Paths:
    """Ours are SfM's poses of the frames that have ground truth, or that are registered where align refused the
    model: ground truth is SfM's poses moved by a similarity."""
    frames = run.table("import", "frames")
    count = len(frames)
    ours_T_cam, ours_model = nothing = np.full((count, 4, 4), np.nan), np.full(count, -1)
    if run.has("sfm"):
        images = run.table("sfm", "images")
        ours_T_cam, ours_model = poses_of(images, "sfm_cam"), pd.factorize(images["model_id"])[0]
    if run.has("align"):
        truth = run.table("align", "ground_truth").set_index("frame_id")["quality"]
        refused = frames["frame_id"].map(truth).fillna("none").to_numpy() == "none"
        ours_model = np.where(refused, -1, ours_model)
    stock = run.stock_model(count)
    stock_T_cam, stock_model = (stock.sfm_T_cam, stock.model) if stock else nothing
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


def agreement_alone(paths: Paths) -> list[Figure]:
    """Agreement with VIO of each way on all of its frames."""
    ours, stock = placed_alone(paths)
    return _agreement(paths, ours, ALL) + _agreement(paths, stock, ALL, STOCK)


def _agreement_figures(run: Run) -> list[Figure]:
    """Agreement with VIO on the frames that both ways have, each way fitted in the same groups; and of each way on all
    of its frames: a model that is folded may be right on those that both have."""
    paths = paths_of(run)
    figures = agreement_alone(paths)
    both = paths.groups(ours=True, stock=True)
    ours, stock = (place(paths.vio_T_cam, poses, both) for poses in (paths.ours_T_cam, paths.stock_T_cam))
    by_way = {OURS: _agreement(paths, ours, COMMON), STOCK: _agreement(paths, stock, COMMON, STOCK)}
    figures += by_way[OURS] + by_way[STOCK]
    for a, b in zip(by_way[OURS], by_way[STOCK], strict=True):
        if a.unit:
            figures.append(Figure(a.name, a.value / b.value if b.value else np.nan, "", RATIO, a.subject))
    return figures + _three_way_figures(paths)


def _three_way_figures(paths: Paths) -> list[Figure]:
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
                Figure(APART, apart, "mm", subject=name),
            ]
            if apart < min(ours, stock):
                of_vio = np.sqrt((ours**2 + stock**2 - apart**2) / 2)
                figures.append(Figure(VIOS_PART, of_vio, "mm", subject=name))
    return figures


def _agreement(paths: Paths, placed: Placed, name: str, way: str = OURS) -> list[Figure]:
    figures = []
    for session in ["", *np.unique(paths.session.astype(str))]:
        rows = np.isfinite(placed.position_m) & ((paths.session == session) | (session == ""))
        if not rows.any():
            continue
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


def _cost_figures(run: Run) -> list[Figure]:
    """Wall and processor seconds and peak memory of each stage, of ours together, of stock, and the ratios."""
    stages = [run.costs[stage] for stage in STAGES if stage in run.costs]
    ours = Cost(
        sum(c.wall_s for c in stages),
        sum(c.cpu_s for c in stages),
        max((c.peak_mib for c in stages), default=0.0),
        sum(c.written_mib for c in stages),
    )
    figures = [f for stage in STAGES if stage in run.costs for f in _cost(run.costs[stage], OURS, stage)]
    figures += _cost(ours, OURS, "")
    if (stock := run.costs.get(STOCK)) is not None:
        figures += _cost(stock, STOCK, "")
        pairs = zip(_cost(ours, OURS, ""), _cost(stock, STOCK, ""), strict=True)
        figures += [Figure(a.name, a.value / b.value, "", RATIO) for a, b in pairs]
    return figures


def _cost(cost: Cost, way: str, subject: str) -> list[Figure]:
    rows = (("wall", cost.wall_s, "s"), ("processor", cost.cpu_s, "s"), ("peak memory", cost.peak_mib, "MiB"))
    return [Figure(name, value, unit, way, subject) for name, value, unit in rows]


def board_figures(judging: pd.DataFrame, setting: pd.DataFrame) -> list[Figure]:
    """Figures of a board from two align.rulers tables: where it judges the map scaled by VIO, and where it sets the
    scale and half of its corners judge; of several models that of most frames."""
    figures = list[Figure]()
    judging = judging[(judging["part"] == RulerPart.ALL) & judging["vio_scale_error_percent"].notna()]
    for row in judging.nlargest(1, "frames").to_dict("records"):
        error, bounds = row["vio_scale_error_percent"], _SIGMAS * row["vio_scale_sd_percent"]
        figures += [
            Figure("board, frames", row["frames"]),
            Figure(BOARD, error, "%"),
            Figure(BOUNDS, bounds, "%"),
            Figure(WITHIN_BOUNDS, abs(error) / bounds),
            Figure("board's corners, reprojection RMS", row["reprojection_px"], "px"),
            Figure("board's corners, RMS", row["corner_rms_mm"], "mm"),
            Figure("board, flat to", row["flatness_mm"], "mm"),
        ]
    setting = setting[(setting["part"] == RulerPart.HELD_OUT) & setting["used_for_scale"]]
    for row in setting.nlargest(1, "frames").to_dict("records"):
        figures += [
            Figure(HELD_OUT, abs(row["scale_error_percent"]), "%"),
            Figure(HELD_OUT_RMS, row["corner_rms_mm"], "mm"),
        ]
    return figures


def depth_figures(agreement: pd.DataFrame) -> list[Figure]:
    """Median ratios of align.depth_agreement by session, distance from the camera and the sensor's confidence."""
    figures = list[Figure]()
    agreement = agreement[agreement["samples"] >= _MIN_POINTS].astype({"confidence": object})
    for row in agreement.to_dict("records"):
        near_m, far_m = row["near_m"], row["far_m"]
        distance = f"{near_m:g} m or more" if pd.isna(far_m) else f"{near_m:g} to {far_m:g} m"
        subject = f"{row['session_id']}, {distance}"
        subject += f", model {row['component'] + 1}" if row["component"] else ""
        confidence = CONFIDENCES[0 if pd.isna(row["confidence"]) else 1 + int(row["confidence"])]
        name = f"{DEPTH}, {confidence} confidence"
        figures += _with_sigma(name, row["median_ratio"], row["median_ratio_se"], "", subject)
        figures.append(Figure(f"{name}, points", row["samples"], subject=subject))
    return figures
