"""Localising by structure, Map and HLoc: `python -m benchmarks.localise`.

Each case builds its map from its training frames alone, asks all its queries, and holds the poses against the ground
truth of align. Needs finished runs (import, sfm, align) of the scenes that are asked for; cases of scenes without are
left out. Writes docs/results/localise.md and .csv.
"""

import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from benchmarks.results import busy_machine, markdown_table, now, side_by_side, write_page
from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.export.regressor import TrainedRegressor, load_regressor
from groundwalk.features.sift import Features
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.localisation.build import build_map
from groundwalk.localisation.compact import CompactMap, read_map, write_map
from groundwalk.localisation.entries import HLocSettings, MapSettings
from groundwalk.localisation.frames import subset
from groundwalk.localisation.hloc import HLocLocaliser
from groundwalk.localisation.inputs import Inputs, read_inputs, training_of
from groundwalk.localisation.localisers import SIFT, StructureSettings
from groundwalk.localisation.prepared import Training, prepare
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.results import NOTHING_SEEN, QueryResult
from groundwalk.localisation.stage import errors_of
from groundwalk.runtime.bundle import matrix_of
from groundwalk.scoring.errors import BOUND_95, normalised_squares, pose_error
from groundwalk.store import DataRoot, UserError
from groundwalk.store.checkout import git_revision
from groundwalk.store.cli import new_app
from groundwalk.store.images import image_file, read_grey_image
from groundwalk.store.parallel import in_parallel, one_thread
from groundwalk.store.tables import table_of

app = new_app(__doc__ or "")

PRIOR_SD_M, PRIOR_SD_DEG = 0.3, 3.0
_TIMED = 40
Rows = NDArray[np.int64]
_PARTS = (8, 4, 2, 1)


@dataclass(frozen=True)
class Figure:
    """One number of a case and localiser."""

    case: str
    localiser: str
    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Case:
    """Queries of a scene, and what the Map must reach with them: figure -> (least, most), None where there is no
    bound."""

    name: str
    scene: str
    queries: str
    targets: dict[str, tuple[float | None, float | None]]


@dataclass(frozen=True)
class Built:
    """The localisers of some training frames, and what they're asked with."""

    inputs: Inputs
    training: Training
    query: Rows
    images: list[Path]
    localiser: MapLocaliser
    bytes_: int
    hloc: HLocLocaliser
    regressors: list[TrainedRegressor]


_HONEST: dict[str, tuple[float | None, float | None]] = {
    "within 95 % bounds": (85.0, 99.0),
    "rank correlation of sigma and error": (0.6, None),
}
_NONE_WRONG: dict[str, tuple[float | None, float | None]] = {"wrong answers": (None, 0.0)}
_CHURCH = {
    "within 25 cm and 2 deg": (99.5, None),
    "median": (None, 0.5),
    "p95": (None, 2.0),
    "file": (None, 2.0),
    "time, median": (None, 80.0),
    "time with a prior, median": (None, 40.0),
    **_NONE_WRONG,
    **_HONEST,
}
CASES = [
    Case("Church", "Church", "test", _CHURCH),
    Case("chair, every fourth", "chair", "every 4", {"within 1 cm and 0.5 deg": (100.0, None), **_NONE_WRONG}),
    *(
        Case(f"charuco, {name} asked", "charuco", f"session {name}", {"within 2 cm and 0.5 deg": (100.0, None)})
        for name in ("test-lowres", "train-highres")
    ),
    Case("corridor, every fifth", "corridor", "every 5", {"within 25 cm and 2 deg": (80.0, None), **_NONE_WRONG}),
]
_GROWTH = Case(
    "Church, growth",
    "Church",
    "test",
    {
        "exponent of query time against training frames": (None, 0.5),
        "exponent of bytes against training frames": (None, 1.0),
    },
)
_LIMITS = [(0.25, 2.0), (0.02, 0.5), (0.01, 0.5), (5.0, 10.0)]


def trained_regressors(data: DataRoot, profile: str, scene: str) -> Iterator[TrainedRegressor]:
    """The regressors of a scene's train stage; none where that hasn't been run."""
    run = data.run(profile, scene)
    if (run / "train" / "models.parquet").is_file():
        for model in table_of(run, "train", "models")["model"]:
            yield load_regressor(data, profile, scene, model)


def answers_of(regressor: TrainedRegressor, files: Mapping[str, Path]) -> list[QueryResult]:
    """What a regressor says of frames, by id, in their order, with these files for their images."""
    frames = regressor.frames.set_index("frame_id", drop=False)
    frames.loc[list(files), "file"] = np.array([*files.values()], object)
    inputs = PhoneInputs(replace(regressor, frames=frames))
    row_of = {frame_id: row for row, frame_id in enumerate(frames.index)}
    return [QueryResult(_pose(inputs, row_of[frame_id]), None, None, "", 0, 0, NOTHING_SEEN) for frame_id in files]


def _pose(inputs: PhoneInputs, row: int) -> Array:
    with torch.inference_mode():
        poses = inputs.regressor.trained.model(torch.from_numpy(inputs.tensor_as_trained(row)))
    seen = matrix_of(poses.quaternion_B4[0].double().numpy())
    rotation = inputs.preprocessing.camera_rotation(seen, inputs.query(row).gravity)
    return make_pose(rotation, poses.position_B3[0].double().numpy())


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="data root with runs of real captures")] = Path("data"),
    simulated: Annotated[
        Path | None, typer.Option(help="data root with the run of simulated Church; default: data")
    ] = None,
    profile: Annotated[str, typer.Option(help="profile of the runs")] = "demo",
    out: Annotated[Path, typer.Option(help="folder for localise.md and .csv")] = Path("docs/results"),
    only: Annotated[str, typer.Option(help="cases whose names start so")] = "",
) -> None:
    """Build each case's map, ask its queries, and write what came out."""
    revision = git_revision()
    figures: list[Figure] = []
    built: dict[tuple[str, str], Built] = {}
    for case in [*CASES, _GROWTH]:
        root = DataRoot(simulated or data) if case.scene == "Church" else DataRoot(data)
        if not case.name.startswith(only) or not root.run(profile, case.scene, "align").is_dir():
            continue
        with one_thread():
            key = case.scene, case.queries
            built[key] = built.get(key) or build(case, root, profile)
            if case is _GROWTH:
                figures += _growth(built[key])
            else:
                figures += run_case(case, built[key])
        # After each case: the last of them take an hour to come to.
        write_report(out, figures, profile, revision)
    if not figures:
        raise UserError("there is no run of any case", where=data, do="run import, sfm and align of Church first")


def build(case: Case, root: DataRoot, profile: str) -> Built:
    """The localisers of a case's training frames."""
    run = root.run(profile, case.scene)
    inputs = read_inputs(run)
    query = query_rows(case.queries, inputs)
    rows = np.setdiff1d(training_rows(case.queries, inputs), query)
    captures, imported = root.captures(case.scene), run / "import"
    images = [image_file(name, captures, imported) for name in inputs.frames["image"]]
    settings = StructureSettings()

    def features_of(row: int) -> Features:
        return SIFT.extract(read_grey_image(images[row]), settings.max_features, settings.max_side)

    training = training_of(inputs, rows, list(in_parallel(features_of, rows.tolist())))
    start = time.process_time()
    prepared = prepare(case.scene, training, settings)
    content = build_map(prepared, MapSettings())
    spent = time.process_time() - start
    print(f"{case.name}: map in {spent:.0f} s, {content.calibration}, {content.priors}", flush=True)
    size, localiser = _kept(content)
    regressors = list(trained_regressors(root, profile, case.scene))
    hloc = HLocLocaliser(prepared, HLocSettings())
    return Built(inputs, training, query, images, localiser, size, hloc, regressors)


def _kept(content: CompactMap) -> tuple[int, MapLocaliser]:
    """The bytes of a map's file, and the localiser out of it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.gwm"
        write_map(file, content)
        return file.stat().st_size, MapLocaliser(read_map(file))


def run_case(case: Case, built: Built) -> list[Figure]:
    """The figures of a case, of both localisers."""
    inputs, query, localiser, hloc = built.inputs, built.query, built.localiser, built.hloc
    gravity = [g if np.isfinite(g).all() else None for g in inputs.gravity]
    files = {row: built.images[row] for row in query.tolist()}
    pictures = {row: read_grey_image(file) for row, file in files.items()}
    asked = [localiser.localise(picture, inputs.logged[row], gravity[row]) for row, picture in pictures.items()]
    without = [localiser.localise(picture, inputs.logged[row]) for row, picture in pictures.items()]
    baseline = [hloc.localise(picture, inputs.logged[row]) for row, picture in pictures.items()]
    truth = inputs.views.map_T_cam[query]
    figures = [
        *_accuracy(case.name, "Map", asked, truth),
        *_accuracy(case.name, "Map without gravity", without, truth),
        *_accuracy(case.name, "HLoc", baseline, truth),
        *_honesty(case.name, "Map", asked, truth),
        Figure(case.name, "Map", "file", built.bytes_ / 1e6, "MB"),
        Figure(case.name, "HLoc", "file", sum(hloc.bytes_by_part().values()) / 1e6, "MB"),
        Figure(case.name, "Map", "points", len(localiser.xyz), ""),
        Figure(case.name, "Map", "training frames", len(built.training.views), ""),
        *_times(case.name, localiser, hloc, list(pictures.values()), inputs, query),
    ]
    ids = inputs.frames["frame_id"]
    for regressor in built.regressors:
        answers = answers_of(regressor, {ids[row]: file for row, file in files.items()})
        figures += _accuracy(case.name, regressor.model, answers, truth)
    _say(figures)
    return figures


def _growth(built: Built) -> list[Figure]:
    """How the Map's query time and bytes grow: maps of every eighth, fourth, second and each training frame."""
    inputs, given = built.inputs, built.training
    rows = built.query[:: max(1, len(built.query) // _TIMED)].tolist()
    pictures = [read_grey_image(built.images[row]) for row in rows]
    figures, frames, ms, sizes = [], [], [], []
    for every in _PARTS:
        some = np.arange(0, len(given.views), every)
        logged, found = tuple(given.logged[row] for row in some), tuple(given.features[row] for row in some)
        training = Training(subset(given.views, some), logged, given.gravity[some], found)
        size, localiser = _kept(build_map(prepare("growth", training, StructureSettings()), MapSettings()))
        costs = []
        for row, picture in zip(rows, pictures, strict=True):
            start, down = time.process_time(), inputs.gravity[row]
            localiser.localise(picture, inputs.logged[row], down if np.isfinite(down).all() else None)
            costs.append(1000 * (time.process_time() - start))
        frames.append(len(some))
        ms.append(float(np.median(costs)))
        sizes.append(size)
        name = f"{len(some)} training frames"
        figures.append(Figure(_GROWTH.name, "Map", f"{name}: time, processor, median", ms[-1], "ms"))
        figures.append(Figure(_GROWTH.name, "Map", f"{name}: file", size / 1e6, "MB"))
    for name, values in (("query time", ms), ("bytes", sizes)):
        slope = float(np.polyfit(np.log(frames), np.log(values), 1)[0])
        figures.append(Figure(_GROWTH.name, "Map", f"exponent of {name} against training frames", slope, ""))
    _say(figures)
    return figures


def _say(figures: Iterable[Figure]) -> None:
    for figure in figures:
        if figure.localiser != "Map without gravity":
            print(f"  {figure.localiser}: {figure.name} {figure.value:.4g} {figure.unit}", flush=True)


def query_rows(queries: str, inputs: Inputs) -> Rows:
    """Rows that are asked: `test` split, `every n` of the rows in order of session and time, or `session name`."""
    kind, _, what = queries.partition(" ")
    if kind == "every":
        return np.arange(len(inputs.frames))[int(what) // 2 :: int(what)]
    column, value = ("session_id", what) if kind == "session" else ("split", "test")
    return np.flatnonzero((inputs.frames[column] == value).to_numpy())


def training_rows(queries: str, inputs: Inputs) -> Rows:
    """Rows that the map may be built from: where splits say what is asked, those of train, as in the stage."""
    return np.flatnonzero((inputs.frames["split"] == "train").to_numpy() | (queries != "test"))


def _accuracy(case: str, localiser: str, answers: Sequence[QueryResult], truth: Array) -> Iterable[Figure]:
    position, rotation = errors_of(answers, truth)
    yield Figure(case, localiser, "queries", len(answers), "")
    yield Figure(case, localiser, "refused", float(np.isinf(position).sum()), "")
    for metres, degrees in _LIMITS:
        share = 100 * float(((position <= metres) & (rotation <= degrees)).mean())
        yield Figure(case, localiser, f"within {100 * metres:g} cm and {degrees:g} deg", share, "%")
    wrong = np.isfinite(position) & ((position > 1) | (rotation > 5))
    yield Figure(case, localiser, "wrong answers", float(wrong.sum()), "")
    yield Figure(case, localiser, "wrong answers by queries", 100 * float(wrong.mean()), "%")
    for name, q in (("median", 50), ("p95", 95)):
        yield Figure(case, localiser, name, 100 * float(np.percentile(position, q, method="lower")), "cm")
        yield Figure(case, localiser, f"{name}, rotation", float(np.percentile(rotation, q, method="lower")), "deg")


def _honesty(case: str, localiser: str, answers: Sequence[QueryResult], truth: Array) -> Iterable[Figure]:
    sure = [(a, t) for a, t in zip(answers, truth, strict=True) if a.map_T_cam is not None and a.covariance is not None]
    if len(sure) < 3:
        return
    errors = np.array([pose_error(a.map_T_cam, t) for a, t in sure if a.map_T_cam is not None])
    covariances = np.array([a.covariance for a, _ in sure])
    rotation, position = normalised_squares(errors, covariances)
    sigma = np.sqrt(np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2))
    correlation = spearmanr(sigma, np.linalg.norm(errors[:, 3:], axis=1)).statistic
    yield Figure(case, localiser, "within 95 % bounds", 100 * float((position <= BOUND_95).mean()), "%")
    yield Figure(case, localiser, "within 95 % bounds, rotation", 100 * float((rotation <= BOUND_95).mean()), "%")
    yield Figure(case, localiser, "rank correlation of sigma and error", float(correlation), "")


def _times(
    case: str,
    localiser: MapLocaliser,
    hloc: HLocLocaliser,
    pictures: Sequence[NDArray[np.uint8]],
    inputs: Inputs,
    query: Rows,
) -> Iterable[Figure]:
    """Milliseconds from a decoded image to its pose, on the clock, and of the processor."""
    rng = np.random.default_rng(0)
    rows = np.unique(np.linspace(0, len(query) - 1, min(_TIMED, len(query))).astype(int))
    costs: dict[tuple[str, str], list[tuple[float, float]]] = {}
    with_prior: list[QueryResult] = []
    for row in rows.tolist():
        image, camera, gravity = pictures[row], inputs.logged[query[row]], inputs.gravity[query[row]]
        down = gravity if np.isfinite(gravity).all() else None
        turn = Rotation.from_rotvec(np.radians(PRIOR_SD_DEG) * rng.standard_normal(3)).as_matrix()
        shift = make_pose(turn, PRIOR_SD_M * rng.standard_normal(3))
        for asked, name, prior in (
            (localiser, "", None),
            (localiser, " with a prior", inputs.views.map_T_cam[query[row]] @ shift),
            (hloc, "", None),
        ):
            start, cpu = time.perf_counter(), time.process_time()
            answer = asked.localise(image, camera, down, prior)
            spent = 1000 * (time.perf_counter() - start), 1000 * (time.process_time() - cpu)
            costs.setdefault(("Map" if asked is localiser else "HLoc", name), []).append(spent)
            with_prior += [answer] if prior is not None else []
    yield from _accuracy(case, "Map with a prior", with_prior, inputs.views.map_T_cam[query[rows]])
    for (name, prior_text), spent_ms in costs.items():
        for part, ms in zip(("", ", processor"), np.transpose(spent_ms), strict=True):
            yield Figure(case, name, f"time{prior_text}{part}, median", float(np.median(ms)), "ms")
            yield Figure(case, name, f"time{prior_text}{part}, p95", float(np.percentile(ms, 95)), "ms")


def write_report(out: Path, figures: Sequence[Figure], profile: str, revision: str) -> None:
    """Write localise.md and localise.csv into the folder."""
    settings = (StructureSettings().model_dump() | MapSettings().model_dump()).items()
    head = now() | {"revision": revision, "machine": busy_machine(), "profile": profile, "seed": "0"}
    head["settings"] = ", ".join(f"{name} {value}" for name, value in settings)
    targets = {(case.name, name): bounds for case in [*CASES, _GROWTH] for name, bounds in case.targets.items()}
    rows: list[list[object]] = [["case", "localiser", "figure", "value", "unit", "least", "most", "met", *head]]
    for f in figures:
        bounds = targets.get((f.case, f.name), (None, None)) if f.localiser == "Map" else (None, None)
        met = "" if bounds == (None, None) else _met(f.value, bounds)
        rows.append([f.case, f.localiser, f.name, f"{f.value:.6g}", f.unit, *bounds, met, *head.values()])
    sections = ["# Localising by structure", _HEADER, "\n".join(f"- {name}: {value}" for name, value in head.items())]
    sections += ["## Against the figures to reach", markdown_table(_target_rows(figures, targets))]
    for case in dict.fromkeys(f.case for f in figures):
        cells = {(f.name, f.localiser): f"{f.value:.4g} {f.unit}" for f in figures if f.case == case}
        sections += [f"## {case}", markdown_table(side_by_side(cells))]
    write_page(out, "localise", sections, rows)


_HEADER = f"""Written by `python -m benchmarks.localise`; not to be edited. Maps are of training frames alone, with
ground-truth poses fixed; queries have their logged intrinsics and, unless it says otherwise, the phone's gravity.
Church is simulated, chair, charuco and corridor are real; errors are against align's ground truth, in which the
queries' images took part.
Shares and percentiles are of all queries, a refused one counts as infinitely wrong. A prior is the ground truth off by
{PRIOR_SD_M} m and {PRIOR_SD_DEG:g} degrees a coordinate, one sigma. Times are from a decoded image to its pose;
`processor` is the time of all cores, which what else runs on the machine changes less. HLoc has the same
features."""


def _target_rows(
    figures: Iterable[Figure], targets: dict[tuple[str, str], tuple[float | None, float | None]]
) -> Iterable[list[str]]:
    yield ["case", "figure of Map", "value", "to reach", ""]
    for f in figures:
        bounds = targets.get((f.case, f.name))
        if bounds and f.localiser == "Map":
            asked = " to ".join(f"{bound:g}" for bound in bounds if bound is not None)
            sign = "" if None not in bounds else "≥ " if bounds[1] is None else "≤ "
            verdict = _met(f.value, bounds).replace("missed", "**missed**")
            yield [f.case, f.name, f"{f.value:.4g} {f.unit}", sign + asked, verdict]


def _met(value: float, bounds: tuple[float | None, float | None]) -> str:
    least, most = bounds
    return "met" if (least is None or value >= least) and (most is None or value <= most) else "missed"


if __name__ == "__main__":
    app()
