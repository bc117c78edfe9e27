"""How good, how fast and how honest ground truth is: `python -m benchmarks.groundtruth --out build/groundtruth`.

Each part can be run alone (`--only speed --only real`) and goes on where it was stopped; its rows are kept in
`<out>/<part>.parquet`, all of them in `<out>/figures.md`. Seconds are processor seconds of the whole process tree, so
that other work on the machine doesn't count, beside them wall seconds. Simulated captures are made below `--out`.
"""

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from benchmarks.groundtruth_inputs import (
    PROFILE,
    errors_after_sim3,
    ground_truth_targets,
    part_of,
    real,
    run_stage,
    sfm_poses,
    simulated,
    true_poses,
)
from benchmarks.stages import Cost, measure
from benchmarks.stock import stock_command, stock_poses
from groundwalk.alignment.check_truth import TruthTarget
from groundwalk.artefacts import DataRoot, UserError
from groundwalk.artefacts.cli import new_app
from groundwalk.artefacts.manifests import load_manifest
from groundwalk.artefacts.progress import console
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.settings import resolve_settings
from groundwalk.artefacts.tables import poses_of, read_table
from groundwalk.geometry.fits import fit_poses, pose_residuals
from groundwalk.geometry.poses import Array
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.stage import STAGE as SFM
from groundwalk.simulation.scenes import NAMES

_SCENE = "Church"
_WINDOW_M = 5.0
_WITHIN = "within 95 % bounds"

app = new_app(__doc__ or "")


@dataclass(frozen=True)
class Figure:
    """One line of a part: of what, what was found, its target (at most, or at least), and whether it's met."""

    part: str
    of: str
    name: str
    value: float
    unit: str
    target: str = ""
    met: bool | None = None


@dataclass(frozen=True)
class Options:
    """What the command line says."""

    out: Path
    shared: Path
    frames: int
    sizes: list[int]
    share: float
    scenes: list[str]
    simulate: list[str]

    @property
    def data(self) -> DataRoot:
        return DataRoot(self.out / "data")


def speed(o: Options) -> list[Figure]:
    """Ours against COLMAP's stock way: same features, every pair matched, incremental mapping."""
    root = _church(o, o.frames)
    truth = true_poses(_SCENE, root)
    ours = _sfm_cost(root)
    folder = o.out / "stock"
    settings = resolve_settings(SfmSettings, "sfm", root, PROFILE, _SCENE, [])
    command = stock_command(_SCENE, PROFILE, root, folder, settings, "captured")
    stock = _kept_cost(o.out / f"stock_{SFM.version}.json", lambda: measure(command, folder))
    of = f"{_SCENE}, {len(truth)} frames"
    errors = _error_figures("speed", f"{of}, ours", *sfm_poses(_SCENE, root), truth)
    stock_errors = _error_figures("speed", f"{of}, stock", *stock_poses(folder, len(truth)), truth)
    ratios = {"processor": stock.cpu_s / ours.cpu_s, "wall": stock.wall_s / ours.wall_s}
    figures = [
        *_cost_figures("speed", f"{of}, ours", ours),
        *_cost_figures("speed", f"{of}, stock", stock),
        *errors,
        *stock_errors,
        *(Figure("speed", of, f"times faster, {name}", ratio, "", "≥ 5", ratio >= 5) for name, ratio in ratios.items()),
    ]
    value_by_name = {figure.name: figure.value for figure in stock_errors}
    for ours_of_it in errors:
        if "error" in ours_of_it.name:
            share = ours_of_it.value / value_by_name[ours_of_it.name]
            figures.append(Figure("speed", of, f"{ours_of_it.name}, of stock's", share, "", "≤ 1", share <= 1))
    return figures


def growth(o: Options) -> list[Figure]:
    """Processor time and memory of sfm over the number of frames."""
    figures, seconds = [], []
    for frames in o.sizes:
        root = _church(o, frames)
        cost = _sfm_cost(root)
        seconds.append(cost.cpu_s)
        figures += _cost_figures("growth", f"{_SCENE}, {frames} frames", cost)
        figures += _error_figures(
            "growth", f"{_SCENE}, {frames} frames", *sfm_poses(_SCENE, root), true_poses(_SCENE, root)
        )
    exponent = float(np.polyfit(np.log(o.sizes), np.log(seconds), 1)[0])
    of = f"{o.sizes[0]} to {o.sizes[-1]} frames"
    return [*figures, Figure("growth", of, "exponent of processor time", exponent, "", "≤ 1.3", exponent <= 1.3)]


def accuracy(o: Options) -> list[Figure]:
    """Ground truth of simulated scenes against the truth: errors, scale, vertical, and the covariances' honesty.

    A scene's errors are few draws, as a model bends in a handful of ways that all of its frames share: the bounds are
    held against the frames of all scenes together.
    """
    figures, bounds = [], list[tuple[TruthTarget, int]]()
    for scene in o.scenes:
        root = o.data
        simulated(scene, root, f"frame_fraction={o.share}", *o.simulate)
        run_stage("sfm", scene, root)
        run_stage("alignment", scene, root)
        gt, targets, bounded = ground_truth_targets(scene, root)
        of = f"{scene}, {len(gt)} frames"
        for t in targets:
            if _WITHIN in t.name:
                bounds.append((t, bounded))
                figures.append(Figure("accuracy", of, t.name, t.value, t.unit))
            else:
                figures.append(Figure("accuracy", of, t.name, t.value, t.unit, t.limits, t.is_met))
        figures += _model_figures("accuracy", of, scene, root)
    for name in dict.fromkeys(t.name for t, _ in bounds):
        of_name = [(t, frames) for t, frames in bounds if t.name == name]
        frames = sum(count for _, count in of_name)
        pooled = replace(of_name[0][0], value=sum(t.value * count for t, count in of_name) / frames)
        of = f"{len(of_name)} scenes, {frames} frames"
        figures.append(Figure("accuracy", of, name, pooled.value, "%", pooled.limits, pooled.is_met))
    return figures


def real_captures(o: Options) -> list[Figure]:
    """Real captures against ARKit: the chair's known answer, and the corridor, right or refused, by an image a second,
    by these with support frames between them, and by all images."""
    figures = []
    for scene, capture, settings in (
        ("chair", "chair", []),
        ("corridor", "corridor", ["max_support_fraction=0"]),
        ("corridor_support", "corridor", []),
        ("corridor_all", "corridor", ['sampling="all"']),
    ):
        if not (o.shared / "captures" / capture).is_dir():
            console.print(f"  {scene}: no capture in {o.shared}, left out")
            continue
        real(scene, o.shared / "captures" / capture, o.data, *settings)
        try:
            run_stage("sfm", scene, o.data)
            run_stage("alignment", scene, o.data)
        except UserError as error:
            # A stage that refuses its input exits with 2; anything else is a failure of ours.
            if "exit status 2" not in str(error):
                raise
            figures.append(Figure("real", scene, "refused", 1, "", "right or refused", capture == "corridor"))
            continue
        folder = o.data.run(PROFILE, scene, "align")
        gt = read_table(folder / "ground_truth.parquet", schema("align", "ground_truth"))
        sfm_figures = load_manifest(folder)["figures"]
        known = int((gt["quality"] != "none").sum())
        figures += _model_figures("real", scene, scene, o.data)
        if scene == "chair":
            rms_mm = 1000 * sfm_figures["sim3_position_rms_m"]
            figures.append(
                Figure(
                    "real",
                    scene,
                    "registered of 24",
                    sfm_figures["registered"],
                    "",
                    "24",
                    sfm_figures["registered"] == 24,
                )
            )
            figures.append(Figure("real", scene, "ARKit after Sim3, RMS", rms_mm, "mm", "≤ 7", rms_mm <= 7))
        else:
            worst = worst_window_share(scene, o.data)
            figures.append(Figure("real", scene, "frames with ground truth", known, f"of {len(gt)}"))
            figures.append(
                Figure("real", scene, f"off from ARKit in any {_WINDOW_M:g} m", worst, "%", "≤ 2", worst <= 2)
            )
    return figures


def repeat(o: Options) -> list[Figure]:
    """Five runs of sfm, on one thread and on all: are the tables the same bytes?"""
    root = _church(o, o.sizes[0])
    runs = []
    for number, threads in enumerate((1, 1, 1, -1, -1)):
        console.print(f"  run {number + 1} of 5, threads={threads}")
        run_stage("sfm", _SCENE, _fresh(o, root, number), f"threads={threads}", anew=True)
        outputs = load_manifest(_fresh(o, root, number).run(PROFILE, _SCENE, "sfm"))["outputs"]
        runs.append({name: digest for name, digest in outputs.items() if name.endswith(".parquet")})
    of = f"{_SCENE}, {o.sizes[0]} frames"
    one, several = sum(run == runs[0] for run in runs[:3]), sum(run == runs[0] for run in runs[3:])
    return [
        Figure("repeat", of, "equal to the last byte, one thread", one, "of 3 runs", "3", one == 3),
        Figure("repeat", of, "equal to the last byte, all threads", several, "of 2 runs", "2", several == 2),
    ]


def mappers(o: Options) -> list[Figure]:
    """The mappers side by side on the same frames."""
    figures = []
    for mapper in ("incremental", "global", "hierarchical", "vio"):
        for scene in (_SCENE, "chair", "corridor"):
            if scene != _SCENE and not (o.shared / "captures" / scene).is_dir():
                continue
            if scene == _SCENE:
                root = _fresh(o, _church(o, o.sizes[0]), f"mapper_{mapper}")
            else:
                root = DataRoot(o.out / f"mapper_{mapper}")
                real(scene, o.shared / "captures" / scene, root, "max_support_fraction=0")
            of = f"{scene}, {mapper}"
            try:
                run_stage("sfm", scene, root, f"mapper={mapper}", "retry=false", "min_registered_fraction=0")
            except UserError:
                figures.append(Figure("mappers", of, "failed", 1, ""))
                continue
            poses, model = sfm_poses(scene, root)
            frames = read_table(root.run(PROFILE, scene, "import") / "frames.parquet", schema("import", "frames"))
            reference = true_poses(scene, root) if scene == _SCENE else poses_of(frames, "vio_cam")
            seconds = load_manifest(root.run(PROFILE, scene, "sfm"))["seconds"]["mapping"]
            figures += _error_figures("mappers", of, poses, model, reference)
            figures.append(Figure("mappers", of, "models", int(model.max()) + 1, ""))
            figures.append(Figure("mappers", of, "mapping, wall", seconds, "s"))
    return figures


PARTS: dict[str, Callable[[Options], list[Figure]]] = {
    "speed": speed,
    "growth": growth,
    "accuracy": accuracy,
    "real": real_captures,
    "repeat": repeat,
    "mappers": mappers,
}


def worst_window_share(scene: str, root: DataRoot) -> float:
    """The largest residual after a rigid fit of VIO to ground truth in any 5 m of path, per cent of the 5 m."""
    frames = read_table(root.run(PROFILE, scene, "import") / "frames.parquet", schema("import", "frames"))
    gt = read_table(root.run(PROFILE, scene, "align") / "ground_truth.parquet", schema("align", "ground_truth"))
    images = read_table(root.run(PROFILE, scene, "sfm") / "images.parquet", schema("sfm", "images"))
    table = frames.merge(gt, on=["frame_id", "session_id", "t_ns"]).merge(
        images[["frame_id", "model_id"]], on="frame_id"
    )
    worst = 0.0
    for _, segment in table[table["quality"] != "none"].groupby(["session_id", "model_id"], sort=True):
        segment = segment.sort_values("t_ns")
        map_T_cam, vio_T_cam = poses_of(segment, "map_cam"), poses_of(segment, "vio_cam")
        steps = np.linalg.norm(np.diff(vio_T_cam[:, :3, 3], axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(steps)])
        for first in range(len(segment)):
            inside = slice(first, int(np.searchsorted(travelled, travelled[first] + _WINDOW_M, side="right")))
            fit = fit_poses(map_T_cam[inside], vio_T_cam[inside], position_sd_m=0.01, rotation_sd=np.radians(1.0))
            worst = max(worst, float(pose_residuals(map_T_cam[inside], vio_T_cam[inside], fit)[0].max()))
    return 100 * worst / _WINDOW_M


def _church(o: Options, frames: int) -> DataRoot:
    """A data folder with the first so many frames of one large simulated Church, imported."""
    whole = DataRoot(o.out / "church")
    most = max(*o.sizes, o.frames)
    config = f"frame_fraction={most / 2496 * 1.05:.4f}"  # 1643 + 853 images in Table I; a little more than is needed
    simulated(_SCENE, whole, config, f"train_sessions={max(3, most // 160)}", *o.simulate)
    part = DataRoot(o.out / f"church_{frames}")
    part_of(_SCENE, whole, part, frames)
    return part


def _fresh(o: Options, root: DataRoot, name: int | str) -> DataRoot:
    """Another data folder with the same import, for another run of sfm."""
    other = DataRoot(o.out / f"{root.root.name}_{name}")
    count = len(read_table(root.run(PROFILE, _SCENE, "import") / "frames.parquet", schema("import", "frames")))
    part_of(_SCENE, root, other, count)
    return other


def _sfm_cost(root: DataRoot) -> Cost:
    """What sfm cost, kept from the run that made its artefact by this version."""
    return _kept_cost(root.root / f"sfm_{SFM.version}_cost.json", lambda: run_stage("sfm", _SCENE, root, anew=True))


def _kept_cost(path: Path, work: Callable[[], Cost]) -> Cost:
    if not path.is_file():
        path.write_text(json.dumps(asdict(work())), encoding="utf-8")
    return Cost(**json.loads(path.read_text(encoding="utf-8")))


def _cost_figures(part: str, of: str, cost: Cost) -> list[Figure]:
    return [
        Figure(part, of, "processor", cost.cpu_s, "s"),
        Figure(part, of, "wall", cost.wall_s, "s"),
        Figure(part, of, "peak memory", cost.peak_mib, "MiB"),
    ]


def _model_figures(part: str, of: str, scene: str, root: DataRoot) -> list[Figure]:
    sfm_figures = load_manifest(root.run(PROFILE, scene, "sfm"))["figures"]
    return [
        Figure(part, of, "models", sfm_figures["models"], ""),
        Figure(part, of, "verified pairs", sfm_figures["verified_pairs"], ""),
        Figure(part, of, "verified pairs inconsistent with VIO", sfm_figures["pairs_inconsistent_with_vio"], ""),
        Figure(part, of, "error of held-out matches", sfm_figures["held_out_px"] or float("nan"), "px"),
        Figure(part, of, "error of fitted matches", sfm_figures["fitted_px"] or float("nan"), "px"),
    ]


def _error_figures(part: str, of: str, sfm_T_cam: Array, model_N: np.ndarray, truth: Array) -> list[Figure]:
    metres, degrees = errors_after_sim3(sfm_T_cam, model_N, truth)
    figures = [Figure(part, of, "registered", 100 * float(np.mean(model_N >= 0)), "%")]
    if not len(metres):
        return figures
    for name, values, unit in (("position", 1000 * metres, "mm"), ("rotation", degrees, "deg")):
        for label, q in (("median", 50), ("95th percentile", 95)):
            figures.append(Figure(part, of, f"{name} error, {label}", float(np.percentile(values, q)), unit))
    return figures


def _write(out: Path, part: str, figures: list[Figure]) -> None:
    pd.DataFrame([asdict(f) for f in figures]).to_parquet(out / f"{part}.parquet", index=False)
    lines = ["| part | of | | found | target | |", "|---|---|---|---|---|---|"]
    for name in PARTS:
        if (out / f"{name}.parquet").is_file():
            for row in pd.read_parquet(out / f"{name}.parquet").itertuples(index=False):
                met = {"True": "ok", "False": "missed"}.get(str(row.met), "")
                lines.append(
                    f"| {row.part} | {row.of} | {row.name} | {row.value:.4g} {row.unit} | {row.target} | {met} |"
                )
    (out / "figures.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


@app.command()
def main(
    only: Annotated[list[str] | None, typer.Option(help=f"Only these parts: {', '.join(PARTS)}.")] = None,
    out: Annotated[Path, typer.Option(help="Captures, runs and tables; what is there is gone on from.")] = Path(
        "build/groundtruth"
    ),
    shared: Annotated[Path, typer.Option(help="Folder with captures/chair and captures/corridor.")] = Path("../shared"),
    frames: Annotated[int, typer.Option(help="Frames of the comparison with COLMAP's stock way.")] = 360,
    sizes: Annotated[str, typer.Option(help="Frames of each step of the growth.")] = "100,200,400,800",
    share: Annotated[float, typer.Option(help="Accuracy: share of Table I's images that is simulated.")] = 0.2,
    scenes: Annotated[str, typer.Option(help="Accuracy: the scenes.")] = ",".join(NAMES),
    simulate: Annotated[list[str] | None, typer.Option(help="A setting of the simulator, key=value.")] = None,
) -> None:
    """Run the parts and write their tables; exits with 1 where a target is missed."""
    unknown = sorted(set(only or []) - set(PARTS))
    if unknown:
        raise UserError("there is no such part", found=", ".join(unknown), expected=f"some of {', '.join(PARTS)}")
    out.mkdir(parents=True, exist_ok=True)
    steps = sorted(int(size) for size in sizes.split(","))
    options = Options(out.resolve(), shared, frames, steps, share, scenes.split(","), simulate or [])
    missed = []
    for part in only or PARTS:
        console.print(f"{part}: {(PARTS[part].__doc__ or '').splitlines()[0]}", markup=False, style="bold")
        figures = PARTS[part](options)
        _write(out, part, figures)
        missed += [figure for figure in figures if figure.met is False]
    print((out / "figures.md").read_text(encoding="utf-8"))
    print(f"{os.cpu_count()} cores; simulated with {', '.join(options.simulate) or 'the demo profile as it is'}")
    if missed:
        raise typer.Exit(1)


if __name__ == "__main__":
    app()
