"""Tables and pictures of the real benchmark's results: real.md, real.csv and a picture of each case."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Drawing

from benchmarks.real_building import SPACING, SPACING_SPREAD, WALLS
from benchmarks.real_figures import (
    ALL,
    APART,
    BOARD,
    BOUNDS,
    COMMON,
    CONFIDENCES,
    DEPTH,
    HELD_OUT,
    HELD_OUT_RMS,
    OURS,
    POSITION,
    RATIO,
    STOCK,
    VIO_WAY,
    VIOS_PART,
    Figure,
    Paths,
    placed_alone,
)
from benchmarks.results import markdown_table, write_page
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, VIO

Rows = list[list[str]]
_WAYS = (OURS, STOCK, RATIO)
_HEADER = """# Real captures

Written by `make bench-real` (`python -m benchmarks.real`), with pictures and `real.csv`, which has every figure; not to
be edited. Profile demo. Images beyond the dataset's frames are support frames, which SfM alone uses. Stock: COLMAP's
incremental mapper with its own options on the same images and as many SIFT features at most, all of `max_image_size`,
every pair matched, one OPENCV camera a session that starts at the median of the logged intrinsics; of several models
its largest. Recordings of VIO alone, without images, aren't among the cases."""


@dataclass(frozen=True)
class Target:
    """A figure to reach, by each subject that has it: at most, or at least."""

    name: str
    limit: float
    unit: str = ""
    at_least: bool = False
    way: str = OURS
    every_subject: bool = False

    def __str__(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {self.limit:g} {self.unit}".strip()


@dataclass(frozen=True, kw_only=True)
class Result:
    """What the tables are written from: one case, when and where it ran, and what came out; `inputs` are the first
    digits of the sha256 of all images' sha256."""

    case: str
    capture: str
    settings: list[str]
    inputs: str
    revision: str
    date: str
    machine: str
    verdict: str
    failed_checks: list[str]
    figures: list[Figure]
    targets: list[Target] = field(default_factory=list)

    def value(self, name: str, way: str = OURS, subject: str = "") -> float | None:
        """A figure's value; None where there is none, or where it isn't finite."""
        for figure in self.figures:
            if (figure.name, figure.way, figure.subject) == (name, way, subject):
                return figure.value if np.isfinite(figure.value) else None
        return None

    def subjects(self, name: str, way: str = OURS) -> list[str]:
        """The subjects that have the figure."""
        return list(dict.fromkeys(f.subject for f in self.figures if (f.name, f.way) == (name, way)))

    def text(self, name: str, unit: str = "", way: str = OURS, subject: str = "") -> str:
        """A figure's value as tables show it."""
        return _number(self.value(name, way, subject), unit)

    def estimate(self, name: str, subject: str, way: str = OURS) -> str:
        """A figure and its standard error."""
        value, sigma = self.value(name, way, subject), self.value(f"{name}, one sigma", way, subject)
        return _fixed(value) + (f" ± {_fixed(sigma)}" if sigma is not None else "")


def judge(figures: Sequence[Figure], target: Target) -> tuple[float | None, bool]:
    """The worst of the figures that a target names, and whether it is met; a figure that isn't there misses it."""
    values = [
        figure.value
        for figure in figures
        if (figure.name, figure.way) == (target.name, target.way) and (target.every_subject or not figure.subject)
    ]
    if not values or not np.isfinite(values).all():
        return None, False
    worst = min(values) if target.at_least else max(values)
    return worst, worst >= target.limit if target.at_least else worst <= target.limit


def write_report(folder: Path, results: Sequence[Result]) -> None:
    """Write real.md and real.csv into the folder."""
    sections = [_HEADER]
    for title, text, rows_of in _SECTIONS:
        head, *rows = (row for number, result in enumerate(results) for row in rows_of(result)[bool(number) :])
        sections += [title, *([text] if text else []), markdown_table([head, *rows])]
    pictures = [
        f"![{result.case}: {what}]({path.name})"
        for result in results
        for suffix, what in (("", "plan and residuals to VIO"), ("_walls", "directions of walls"))
        if (path := folder / f"real_{result.case}{suffix}.png").is_file()
    ]
    write_page(folder, "real", [*sections, "## Pictures", *pictures], _figure_rows(results))


def _figure_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    """One row a figure, and one a case's verdict; where a figure has a target, that and whether it's met."""
    yield ["case", "way", "subject", "figure", "value", "unit", "target", "met", "revision", "date"]
    for result in results:
        run = [result.revision, result.date]
        yield [result.case, OURS, "", "verdict", result.verdict, "", "", "", *run]
        targets = {(t.name, t.way): t for t in result.targets}
        for figure in result.figures:
            target = targets.get((figure.name, figure.way))
            judged = ["", ""]
            if target and (target.every_subject or not figure.subject):
                judged = [str(target), "met" if judge([figure], target)[1] else "missed"]
            row = [result.case, figure.way, figure.subject, figure.name, f"{figure.value:.6g}", figure.unit]
            yield [*row, *judged, *run]


def _targets(r: Result) -> Rows:
    rows = [["case", "figure", "value", "to reach", ""]]
    for target in r.targets:
        value, met = judge(r.figures, target)
        way = "" if target.way == OURS else f", {target.way}"
        worst = " (worst session)" if target.every_subject else ""
        rows.append([r.case, f"{target.name}{way}{worst}", _number(value, target.unit), str(target)])
        rows[-1].append("met" if met else "**missed**")
    return rows


def _ground_truth(r: Result) -> Rows:
    head = ["case", "verdict", "images (of them support)", "registered, ours / stock", "frames with ground truth"]
    head += ["A, B, C", "models", "failed checks", "scale ±", "reprojection px", "held out px"]
    truth = f"{r.text('frames with ground truth')} of {r.text('frames')}"
    registered, errors, models = (
        f"{r.text(name)} / {r.text(name, way=STOCK)}"
        for name in ("images registered", "reprojection error, mean", "models")
    )
    classes = ", ".join(r.text(f"class {name}") for name in "ABC")
    failed = "; ".join([f"{r.text('checks failed')} of {r.text('checks')}", *r.failed_checks])
    row = [r.case, r.verdict, f"{r.text('images')} ({r.text('support frames')})", registered, truth, classes, models]
    return [head, [*row, failed, r.text("scale, one sigma", "%"), errors, r.text("held-out error, median")]]


def _cameras(r: Result) -> Rows:
    rows = [["case", "of", "k1", "k2", "k3", "readout ms", "focal scale", "stock k1", "stock k2", "stock focal scale"]]
    for lens in r.subjects("k1"):
        rows.append([r.case, lens, *(r.estimate(name, lens) for name in ("k1", "k2", "k3", "readout")), *[""] * 4])
    for session in dict.fromkeys([*r.subjects("focal scale"), *r.subjects("k1", STOCK)]):
        stock = [r.estimate(name, session, STOCK) for name in ("k1", "k2", "focal scale")]
        rows.append([r.case, session, *[""] * 4, r.estimate("focal scale", session), *stock])
    return rows


def _agreement(r: Result) -> Rows:
    rows = [["case", "session", "frames", "position RMS mm: ours", "stock", "ratio", "rotation median deg: ours"]]
    rows[0] += ["stock", "ratio", "step RMS mm: ours", "stock", "ratio", "all of ours: frames, mm, deg"]
    rows[0].append("all of stock's")
    for session in dict.fromkeys([*r.subjects(ALL), *r.subjects(ALL, STOCK)]):
        row = [r.case, session or "all", r.text(COMMON, subject=session)]
        for figure in ("position RMS", "rotation median", "step RMS"):
            row += [r.text(f"{COMMON}, {figure}", way=way, subject=session) for way in _WAYS]
        for way in (OURS, STOCK):
            names = (ALL, f"{ALL}, position RMS", f"{ALL}, rotation median")
            row.append(", ".join(r.text(name, way=way, subject=session) for name in names))
        rows.append(row)
    return rows


def _three_way(r: Result) -> Rows:
    rows = [["case", "session", "ours to VIO", "stock to VIO", "ratio", "ours to stock", "VIO's part"]]
    for session in r.subjects(APART):
        ways = [
            " ± ".join(r.text(name, way=way, subject=session) for name in (POSITION, f"{POSITION}, one sigma"))
            for way in _WAYS
        ]
        apart, vio = (r.text(name, subject=session) for name in (APART, VIOS_PART))
        rows.append([r.case, session or "all", *ways, apart, vio])
    return rows


def _walls(r: Result) -> Rows:
    ways = (VIO_WAY, OURS, STOCK)
    rows = [["case", *ways]]
    return [*rows, [r.case, *(r.text(WALLS, way=way) for way in ways)]] if r.subjects(WALLS, VIO_WAY) else rows


def _floor(r: Result) -> Rows:
    rows = [["case", "leg", "VIO", "ours", "distances", "standard deviation: VIO", "ours"]]
    for leg in r.subjects(SPACING):
        rows.append([r.case, leg, *(r.text(SPACING, way=way, subject=leg) for way in (VIO_WAY, OURS)), "", "", ""])
    if r.subjects(SPACING_SPREAD):
        spread = [r.text(SPACING_SPREAD, "%", way) for way in (VIO_WAY, OURS)]
        rows.append([r.case, "all", "", "", r.text("spacings of floor bands"), *spread])
    return rows


def _board(r: Result) -> Rows:
    rows = [["case", "frames", "error by VIO", "95 % bounds", "corners: px RMS", "mm RMS", "flat to mm"]]
    rows[0] += ["held out: error", "mm RMS"]
    if r.subjects(BOARD):
        names = ("board's corners, reprojection RMS", "board's corners, RMS", "board, flat to")
        row = [r.case, r.text("board, frames"), r.text(BOARD, "%"), f"± {r.text(BOUNDS, '%')}"]
        rows.append([*row, *(r.text(name) for name in names), r.text(HELD_OUT, "%"), r.text(HELD_OUT_RMS)])
    return rows


def _depth(r: Result) -> Rows:
    names = [f"{DEPTH}, {confidence} confidence" for confidence in CONFIDENCES]
    rows = [["case", "session, distance", "points", *(f"{confidence} confidence" for confidence in CONFIDENCES)]]
    for subject in r.subjects(names[0]):
        points = r.text(f"{names[0]}, points", subject=subject)
        rows.append([r.case, subject, points, *(r.estimate(name, subject) for name in names)])
    return rows


def _cost(r: Result) -> Rows:
    def seconds(way: str, subject: str) -> str:
        processor, wall = (r.value(name, way, subject) for name in ("processor", "wall"))
        return "" if processor is None or wall is None else f"{processor:.0f} s ({wall / 60:.1f} min)"

    head = ["case", "import", "sfm", "align", "ours", "stock", "ours / stock: processor", "wall", "peak MiB: ours"]
    costs = [seconds(OURS, subject) for subject in ("import", "sfm", "align", "")]
    ratios = [r.text(name, way=RATIO) for name in ("processor", "wall")]
    memory = [r.text("peak memory", way=way) for way in (OURS, STOCK)]
    return [[*head, "stock"], [r.case, *costs, seconds(STOCK, ""), *ratios, *memory]]


def _runs(r: Result) -> Rows:
    settings = " ".join(f"`{s}`" for s in r.settings) or "default"
    row = [r.case, r.capture, settings, r.inputs, r.revision, r.date, r.machine]
    return [["case", "capture", "import settings", "images (sha256)", "revision", "date", "machine"], row]


_SECTIONS = (
    ("## Against the figures to reach", "", _targets),
    (
        "## Ground truth",
        "Reprojection error: mean over observations, ours / stock. Held out: median Sampson distance of matches that "
        "took no part.",
        _ground_truth,
    ),
    ("## Cameras", "± one sigma. Focal scale: times the logged focal lengths.", _cameras),
    (
        "## Agreement with VIO",
        "Frames of the dataset that both have; each session in each model fitted to VIO, positions by a Sim3, "
        "rotations by a mean rotation; and all frames that either has. VIO isn't the truth: it drifts, and a model of "
        "fewer frames has less of that drift to explain. Steps, the motion from frame to frame, show little of it.",
        _agreement,
    ),
    (
        "### VIO's part of the residuals",
        "Positions of the same frames, millimetres RMS; ± one sigma, by leaving out each eighth of every session once. "
        "Ours and stock have the same images. Where they are nearer to each other than to VIO, most of the residuals "
        "is VIO's, or an error that both share. VIO's part: what a model without any error would show, where errors of "
        "the three are independent.",
        _three_way,
    ),
    (
        "## Directions of walls",
        "Where all walls are at right angles, each image shows how it is turned to them. How far their directions "
        "spread over the walk by the poses of each: 5th to 95th percentile, degrees, of a running median over 9 "
        "frames. This judges turns without VIO's or SfM's help; a model that is folded by right angles, as stock's of "
        "the corridor, shows no spread.",
        _walls,
    ),
    (
        "## Bands of the floor",
        "Where tiles lie in rows of equal length, the bands across a floor are a ruler. Each image is drawn onto the "
        "floor by its pose: distances of neighbouring bands, metres, median of each straight leg of the walk, and the "
        "standard deviation of all about it. It judges how scale drifts along the walk without VIO's or SfM's help.",
        _floor,
    ),
    (
        "## Ruler",
        "A printed board in view, at its stated size. First it judges the map scaled by VIO: the error of its scale, "
        "beside that scale's own 95 % bounds. Then it sets the scale, in align alone; every second corner is held out "
        "and judges it, seen by the same frames: an error of the print or of the poses around it doesn't show.",
        _board,
    ),
    (
        "## Depth",
        "Depth by the phone's sensor over the map's, which takes nothing from it, at the points of SfM, by distance "
        "from the camera and by the sensor's confidence: median ± one sigma, of 100 points or more.",
        _depth,
    ),
    (
        "## Cost",
        "Processor seconds of the whole process tree, wall minutes beside; peak memory of the largest process. Ours: "
        "import + sfm + align.",
        _cost,
    ),
    ("## Runs", "", _runs),
)


def draw_case(path: Path, title: str, paths: Paths) -> None:
    """One row a session: plan in its VIO frame, each model fitted by a Sim3, and residuals over VIO's path."""
    ours, stock = placed_alone(paths)
    ways = {"stock COLMAP": (stock, NEUTRAL, "--"), "ours": (ours, GROUND_TRUTH, "-")}
    sessions = list(np.unique(paths.session.astype(str)))
    drawing = Drawing(figsize=(12, 3 * len(sessions) + 0.4), layout="constrained")
    for (plan, *residuals), session in zip(drawing.subplots(len(sessions), 3, squeeze=False), sessions, strict=True):
        rows = np.flatnonzero((paths.session == session) & np.isfinite(paths.vio_T_cam[:, 0, 0]))
        vio = paths.vio_T_cam[rows, :3, 3]
        travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vio, axis=0), axis=1))])[: len(rows)]
        plan.plot(vio[:, 0], vio[:, 2], ".-", ms=3, lw=1.2, color=np.array(VIO) / 255, label="VIO")
        for name, (placed, colour, line) in ways.items():
            xyz, style = placed.xyz_vio[rows], {"ls": line, "ms": 3, "lw": 1, "color": np.array(colour) / 255}
            label = f"{name}, {np.isfinite(xyz[:, 0]).sum()} of {len(rows)} frames"
            plan.plot(xyz[:, 0], xyz[:, 2], ".", label=label, **style)
            residuals[0].plot(travelled_m, 1000 * placed.position_m[rows], ".", **style)
            residuals[1].plot(travelled_m, placed.rotation_deg[rows], ".", **style)
        plan.set_aspect("equal", adjustable="datalim")
        plan.invert_yaxis()
        plan.set_title(f"{session}: plan in its VIO frame, m", fontsize=8)
        plan.legend(fontsize=7)
        of_ours = (1000 * ours.position_m, ours.rotation_deg)
        for axes, unit, values in zip(residuals, ("mm", "deg"), of_ours, strict=True):
            # A model of stock's that is folded would leave nothing to see of ours.
            top = 4 * np.nanmax(values[rows], initial=0.0)
            axes.set_ylim(0, min(top, axes.get_ylim()[1]) if top > 0 else None)
            axes.set_title(f"from VIO, {unit}", fontsize=8)
            axes.set_xlabel("VIO path, m", fontsize=7)
    drawing.suptitle(title, fontsize=10, wrap=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=80)


def _fixed(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}" if abs(value) >= 2 else f"{value:.4f}"


def _number(value: float | None, unit: str = "") -> str:
    if value is None:
        return "none"
    text = f"{value:.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.3g}"
    return f"{text} {unit}".strip()
