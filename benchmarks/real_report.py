"""Tables of the real benchmark's results: real.md and real.csv, and real-stability.md."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.real_cases import Result, judge
from benchmarks.real_figures import OURS, POSITION, RATIO, STOCK, VIO_WAY
from benchmarks.real_floor import SPACING
from benchmarks.real_floor import SPREAD as SPACING_SPREAD
from benchmarks.real_scale import BOARD, BOUNDS, CONFIDENCES, DEPTH, HELD_OUT, HELD_OUT_RMS
from benchmarks.real_stability import Tried, agreeing
from benchmarks.real_walls import SPREAD
from benchmarks.results import markdown_table

_HEADER = """# Real captures

Written by `make bench-real` (`python -m benchmarks.real`), with pictures and `real.csv`, which has every figure; not to
be edited. Profile demo. Images beyond the dataset's frames are support frames, which SfM alone uses. Stock: COLMAP's
incremental mapper with its own options on the same images and as many SIFT features at most, all of `max_image_size`,
every pair matched, one OPENCV camera a session that starts at the median of the logged intrinsics; of several models
its largest. Recordings of VIO alone, without images, aren't among the cases.
"""

_WALL_WAYS = (VIO_WAY, OURS, STOCK)

_STABILITY_HEADER = """# Real captures, resampled

Written by `make bench-real stability=1` (`python -m benchmarks.real --stability`), not to be edited. Profile demo.
Images are left out of a copy of the capture, its log of poses stays whole; 1, 2 and 5 Hz are import's `rate_hz`, with
`min_frames=0`.
"""


def write_report(folder: Path, results: Sequence[Result]) -> None:
    """Write real.md and real.csv into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    sections = [
        _HEADER,
        "## Against the figures to reach\n\n" + markdown_table(_target_rows(results)),
        "## Ground truth\n\n"
        "Reprojection error: mean over observations, ours / stock. Held out: median Sampson distance of matches that "
        "took no part.\n\n" + markdown_table(_ground_truth_rows(results)),
        "## Cameras\n\n± one sigma. Focal scale: times the logged focal lengths.\n\n"
        + markdown_table(_camera_rows(results)),
        "## Agreement with VIO\n\n"
        "Frames of the dataset that both have; each session in each model fitted to VIO, positions by a Sim3, "
        "rotations by a mean rotation; and all frames that either has. VIO isn't the truth: it drifts, and a model of "
        "fewer frames has less of that drift to explain. Steps, the motion from frame to frame, show little of it.\n\n"
        + markdown_table(_agreement_rows(results)),
        "### VIO's part of the residuals\n\n"
        "Positions of the same frames, millimetres RMS; ± one sigma, by leaving out each eighth of every session once. "
        "Ours and stock have the same images. Where they are nearer to each other than to VIO, most of the residuals "
        "is VIO's, or an error that both share. VIO's part: what a model without any error would show, where errors of "
        "the three are independent.\n\n" + markdown_table(_three_way_rows(results)),
        "## Directions of walls\n\n"
        "Where all walls are at right angles, each image shows how it is turned to them. How far their directions "
        "spread over the walk by the poses of each: 5th to 95th percentile, degrees, of a running median over 9 "
        "frames. This judges turns without VIO's or SfM's help; a model that is folded by right angles, as stock's of "
        "the corridor, shows no spread.\n\n" + markdown_table(_wall_rows(results)),
        "## Bands of the floor\n\n"
        "Where tiles lie in rows of equal length, the bands across a floor are a ruler. Each image is drawn onto the "
        "floor by its pose: distances of neighbouring bands, metres, median of each straight leg of the walk, and the "
        "standard deviation of all about it. It judges how scale drifts along the walk without VIO's or SfM's help.\n\n"
        + markdown_table(_floor_rows(results)),
        "## Ruler\n\n"
        "A printed board in view, at its stated size. First it judges the map scaled by VIO: the error of its scale, "
        "beside that scale's own 95 % bounds. Then it sets the scale, in align alone; every second corner is held out "
        "and judges it, seen by the same frames: an error of the print or of the poses around it doesn't show.\n\n"
        + markdown_table(_board_rows(results)),
        "## Depth\n\n"
        "Depth by the phone's sensor over the map's, which takes nothing from it, at the points of SfM, by distance "
        "from the camera and by the sensor's confidence: median ± one sigma, of 100 points or more.\n\n"
        + markdown_table(_depth_rows(results)),
        "## Cost\n\n"
        "Processor seconds of the whole process tree, wall minutes beside; peak memory of the largest process. Ours: "
        "import + sfm + align.\n\n" + markdown_table(_cost_rows(results)),
        "## Runs\n\nLoad: processes that were busy on the machine as it began.\n\n"
        + markdown_table(_run_rows(results)),
        "## Pictures\n\n" + "\n\n".join(_pictures(folder, results)),
    ]
    (folder / "real.md").write_text("\n\n".join(s.strip() for s in sections) + "\n", encoding="utf-8")
    (folder / "real.csv").write_text(csv_text(results), encoding="utf-8")


def write_stability(folder: Path, stability: Sequence[Tried]) -> None:
    """Write real-stability.md into the folder."""
    head = ["case", "resampling", "images", "verdict", "frames with ground truth", "A, B, C", "agrees with the whole"]
    rows = [[*head, "revision"]]
    for tried in stability:
        classes = ", ".join(str(tried.classes[name]) for name in "ABC") if tried.classes else ""
        same = "" if tried.is_whole else "yes" if tried.agrees else "**no**"
        truth = "" if tried.with_ground_truth is None else str(tried.with_ground_truth)
        row = [tried.case, tried.resampling, str(tried.images), str(tried.verdict), truth, classes, same]
        rows.append([*row, tried.revision])
    agree, count = agreeing(stability)
    share = f"{agree} of {count} resamplings ({100 * agree / count:.0f} %) have the whole's verdict; 95 % to reach."
    folder.mkdir(parents=True, exist_ok=True)
    text = f"{_STABILITY_HEADER}\n{share}\n\n{markdown_table(rows)}\n"
    (folder / "real-stability.md").write_text(text, encoding="utf-8")


def csv_text(results: Iterable[Result]) -> str:
    """One row a figure, and one a case's verdict; where a figure has a target, that and whether it's met."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["case", "way", "subject", "figure", "value", "unit", "target", "met", "revision", "date"])
    for result in results:
        run = [result.revision, result.date]
        writer.writerow([result.case, OURS, "", "verdict", str(result.verdict), "", "", "", *run])
        targets = {(t.name, t.way): t for t in result.targets}
        for figure in result.figures:
            target = targets.get((figure.name, figure.way))
            judged: list[object] = ["", ""]
            if target and (target.every_subject or not figure.subject):
                judged = [str(target), _met(judge([figure], target).met)]
            row = [result.case, figure.way, figure.subject, figure.name, f"{figure.value:.6g}", figure.unit]
            writer.writerow([*row, *judged, *run])
    return text.getvalue()


def _met(met: bool) -> str:
    return "met" if met else "missed"


def _target_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield ["case", "figure", "value", "to reach", ""]
    for result in results:
        for target in result.targets:
            judged = judge(result.figures, target)
            way = "" if target.way == OURS else f", {target.way}"
            worst = " (worst session)" if target.every_subject else ""
            value = _number(judged.value, target.unit)
            met = _met(judged.met) if judged.met else f"**{_met(judged.met)}**"
            yield [result.case, f"{target.name}{way}{worst}", value, str(target), met]


def _ground_truth_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield [
        *("case", "verdict", "images (of them support)", "registered, ours / stock", "frames with ground truth"),
        *("A, B, C", "models", "failed checks", "scale ±", "reprojection px", "held out px"),
    ]
    for r in results:
        classes = (
            ", ".join(_number(r.value(f"class {name}")) for name in "ABC")
            if r.value("class A or B") is not None
            else ""
        )
        truth, frames = (_number(r.value(name)) for name in ("frames with ground truth", "frames"))
        registered, errors, models = (
            f"{_number(r.value(name))} / {_number(r.value(name, STOCK))}"
            for name in ("images registered", "reprojection error, mean", "models")
        )
        failed = f"{_number(r.value('checks failed'))} of {_number(r.value('checks'))}"
        if r.value("checks") is None:
            failed = "none were made"
        yield [
            *(
                r.case,
                str(r.verdict),
                f"{_number(r.value('images'))} ({_number(r.value('support frames'))})",
                registered,
            ),
            *(f"{truth} of {frames}", classes, models, "; ".join([failed, *r.failed_checks])),
            *(_number(r.value("scale, one sigma"), "%"), errors, _number(r.value("held-out error, median"))),
        ]


def _camera_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield ["case", "of", "k1", "k2", "k3", "readout ms", "focal scale", "stock k1", "stock k2", "stock focal scale"]
    for r in results:
        for lens in r.subjects("k1"):
            estimated = [_with_sigma(r, name, lens) for name in ("k1", "k2", "k3", "readout")]
            yield [r.case, lens, *estimated, *[""] * 4]
        for session in dict.fromkeys([*r.subjects("focal scale"), *r.subjects("k1", STOCK)]):
            stock = [_fixed(r.value(name, STOCK, session)) for name in ("k1", "k2", "focal scale")]
            yield [r.case, session, *[""] * 4, _with_sigma(r, "focal scale", session), *stock]


def _with_sigma(result: Result, name: str, subject: str) -> str:
    value, sigma = result.value(name, OURS, subject), result.value(f"{name}, one sigma", OURS, subject)
    return _fixed(value) + (f" ± {_fixed(sigma)}" if sigma is not None else "")


def _fixed(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}" if abs(value) >= 2 else f"{value:.4f}"


def _agreement_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    name, all_frames = "common frames against VIO", "all frames against VIO"
    figures = (", position RMS", ", rotation median")
    yield [
        *("case", "session", "frames", "position RMS mm: ours", "stock", "ratio"),
        *("rotation median deg: ours", "stock", "ratio", "step RMS mm: ours", "stock", "ratio"),
        *("all of ours: frames, mm, deg", "all of stock's"),
    ]
    for r in results:
        for session in dict.fromkeys([*r.subjects(all_frames), *r.subjects(all_frames, STOCK)]):
            position, rotation, step = (
                [_number(r.value(f"{name}{figure}", way, session)) for way in (OURS, STOCK, RATIO)]
                for figure in (*figures, ", step RMS")
            )
            every = [
                [_number(r.value(f"{all_frames}{figure}", way, session)) for figure in ("", *figures)]
                for way in (OURS, STOCK)
            ]
            frames = _number(r.value(name, OURS, session))
            yield [
                r.case,
                session or "all",
                frames,
                *position,
                *rotation,
                *step,
                *(", ".join(values) for values in every),
            ]


def _three_way_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield ["case", "session", "ours to VIO", "stock to VIO", "ratio", "ours to stock", "VIO's part"]
    for r in results:
        for session in r.subjects("ours and stock apart, position RMS"):
            yield [
                r.case,
                session or "all",
                *(
                    f"{_number(r.value(POSITION, way, session))} ± "
                    f"{_number(r.value(f'{POSITION}, one sigma', way, session))}"
                    for way in (OURS, STOCK, RATIO)
                ),
                _number(r.value("ours and stock apart, position RMS", OURS, session)),
                _number(r.value("VIO's part of the residuals, position RMS", OURS, session)),
            ]


def _wall_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield ["case", *_WALL_WAYS]
    for r in results:
        if r.value(SPREAD, VIO_WAY) is not None:
            yield [r.case, *(_number(r.value(SPREAD, way)) for way in _WALL_WAYS)]


def _floor_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    ways = (VIO_WAY, OURS)
    yield ["case", "leg", "VIO", "ours", "distances", "standard deviation: VIO", "ours"]
    for r in results:
        for leg in r.subjects(SPACING, OURS):
            yield [r.case, leg, *(_number(r.value(SPACING, way, leg)) for way in ways), "", "", ""]
        if r.value(SPACING_SPREAD, OURS) is not None:
            count = _number(r.value("spacings of floor bands", OURS))
            yield [r.case, "all", "", "", count, *(_number(r.value(SPACING_SPREAD, way), "%") for way in ways)]


def _board_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield [
        *("case", "frames", "error by VIO", "95 % bounds", "corners: px RMS", "mm RMS", "flat to mm"),
        *("held out: error", "mm RMS"),
    ]
    names = ("board's corners, reprojection RMS", "board's corners, RMS", "board, flat to")
    for r in results:
        if r.value(BOARD) is not None:
            yield [
                *(r.case, _number(r.value("board, frames")), _number(r.value(BOARD), "%")),
                *(f"± {_number(r.value(BOUNDS), '%')}", *(_number(r.value(name)) for name in names)),
                *(_number(r.value(HELD_OUT), "%"), _number(r.value(HELD_OUT_RMS))),
            ]


def _depth_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    names = [f"{DEPTH}, {confidence} confidence" for confidence in CONFIDENCES]
    yield ["case", "session, distance", "points", *(f"{confidence} confidence" for confidence in CONFIDENCES)]
    for r in results:
        for subject in r.subjects(names[0]):
            points = _number(r.value(f"{names[0]}, points", OURS, subject))
            yield [r.case, subject, points, *(_with_sigma(r, name, subject) for name in names)]


def _cost_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield [
        *("case", "import", "sfm", "align", "ours", "stock", "ours / stock: processor", "wall"),
        *("peak MiB: ours", "stock"),
    ]
    for r in results:
        costs = [_cost(r, OURS, subject) for subject in ("import", "sfm", "align", "")]
        ratios = [_number(r.value(name, RATIO)) for name in ("processor", "wall")]
        memory = [_number(r.value("peak memory", way)) for way in (OURS, STOCK)]
        yield [r.case, *costs, _cost(r, STOCK, ""), *ratios, *memory]


def _cost(result: Result, way: str, subject: str) -> str:
    processor, wall = (result.value(name, way, subject) for name in ("processor", "wall"))
    return "" if processor is None or wall is None else f"{processor:.0f} s ({wall / 60:.1f} min)"


def _run_rows(results: Iterable[Result]) -> Iterable[list[str]]:
    yield ["case", "capture", "import settings", "seed", "images (sha256)", "revision", "date", "load", "machine"]
    for r in results:
        settings = " ".join(f"`{s}`" for s in r.settings) or "default"
        run = [r.inputs, r.revision, r.date, f"{r.system_load:g}", r.machine]
        yield [r.case, r.capture, settings, str(r.seed), *run]


def _pictures(folder: Path, results: Iterable[Result]) -> Iterable[str]:
    for result in results:
        for name, what in (
            (f"real_{result.case}.png", "plan and residuals to VIO of ours and stock COLMAP"),
            (f"real_{result.case}_walls.png", "directions of walls by VIO, ours and stock COLMAP"),
        ):
            if (folder / name).is_file():
                yield f"![{result.case}: {what}]({name})"


def _number(value: float | None, unit: str = "") -> str:
    if value is None:
        return "none"
    text = f"{value:.0f}" if abs(value) >= 1000 or value == round(value) else f"{value:.3g}"
    return f"{text} {unit}".strip()
