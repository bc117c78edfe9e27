"""Stock COLMAP as well as it can be told, beside ours, on real captures of one session: `python -m benchmarks.peers`.

Stock gets the same images and as many features, an OPENCV camera that starts at the logged intrinsics, and, way by way,
the pairs, position priors, gravity and larger camera model that a user who has VIO could give it. Each way is kept as
`<work>/<capture>/<way>.json` when it is done, and the same command goes on with the rest. Writes docs/results/peers.md
and peers.csv.
"""

import shutil
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer

from benchmarks.real import Case, standard_cases
from benchmarks.real_building import WALLS, wall_figures
from benchmarks.real_figures import ALL, OURS, STOCK, Figure, Run, agreement_alone, paths_of, run_stages
from benchmarks.results import CAPTURES, circumstances_of, kept, markdown_table, now, write_page
from benchmarks.stock import SPATIAL_M, run_stock
from groundwalk.store.cli import new_app

app = new_app(__doc__ or "")

_NEAR = f"pairs within {SPATIAL_M:g} m by VIO"
# What stock COLMAP is told, in words and as options of `benchmarks.stock`.
_WAYS: dict[str, tuple[str, ...]] = {
    "every pair": ("--pairs", "exhaustive"),
    "every pair, position priors ± 0.5 m": ("--pairs", "exhaustive", "--prior-sd-m", "0.5"),
    "every pair, FULL_OPENCV camera": ("--pairs", "exhaustive", "--camera-model", "FULL_OPENCV"),
    "sequential pairs": ("--pairs", "sequential"),
    _NEAR: ("--pairs", "spatial"),
    f"{_NEAR}, position priors ± 0.5 m": ("--pairs", "spatial", "--prior-sd-m", "0.5"),
    f"{_NEAR}, position priors ± 0.1 m": ("--pairs", "spatial", "--prior-sd-m", "0.1"),
    f"{_NEAR}, global mapper, gravity": ("--pairs", "spatial", "--gravity"),
}


def stock_figures(run: Run, folder: Path, way: str, is_of_right_angles: bool) -> list[Figure]:
    """Map the images of an imported capture with stock COLMAP in one way: coverage, agreement with VIO, cost."""
    told = Run(run.scene, run.root, folder / "stock", run.profile)
    status, cost = run_stock(run.scene, run.profile, run.root, told.stock_folder, *_WAYS[way])
    images = len(run.table("import", "frames"))
    figures = [Figure("processor", cost.cpu_s, "s"), Figure("wall", cost.wall_s / 60, "min")]
    figures.append(Figure("models", len(list(told.stock_folder.glob("[0-9]*"))) if not status else 0))
    if (model := told.stock_model(images)) is None:
        return [*figures, Figure("images registered", 0)]
    figures.append(Figure("images registered", int(model.registered.sum())))
    figures.append(Figure("reprojection error, mean", model.mean_error_px, "px"))
    return figures + _agreement(told, folder, STOCK, is_of_right_angles)


def our_figures(run: Run, folder: Path, is_of_right_angles: bool) -> list[Figure]:
    """The same of our ground truth."""
    costs = [run.costs[stage] for stage in ("import", "sfm", "align")]
    values = run.manifest("sfm")["figures"]
    figures = [
        Figure("processor", sum(cost.cpu_s for cost in costs), "s"),
        Figure("wall", sum(cost.wall_s for cost in costs) / 60, "min"),
        Figure("models", values["models"]),
        Figure("images registered", values["registered"]),
        Figure("reprojection error, mean", values["mean_reprojection_px"], "px"),
    ]
    return figures + _agreement(run, folder, OURS, is_of_right_angles)


def _agreement(run: Run, folder: Path, way: str, is_of_right_angles: bool) -> list[Figure]:
    """Of one way with VIO and, where there are some, with walls at right angles."""
    figures = agreement_alone(paths_of(run)) + (wall_figures(run, folder / "walls.png") if is_of_right_angles else [])
    return [figure for figure in figures if figure.way == way and not figure.subject]


def _table(rows: Iterable[dict[str, Any]]) -> Iterable[list[str]]:
    yield [
        *("capture", "way", "images", "models", "reprojection px", "frames held against VIO", "position RMS m"),
        *("rotation median deg", "step RMS mm", "walls deg", "processor s (wall min)"),
    ]
    for row in rows:
        value = {figure["name"]: figure["value"] for figure in row["figures"]}

        def cell(name: str, form: str, factor: float = 1.0, value: dict[str, float] = value) -> str:
            return format(factor * value[name], form) if name in value else ""

        yield [
            *(row["capture"], row["way"], f"{cell('images registered', 'g')} of {row['images']}", cell("models", "g")),
            cell("reprojection error, mean", ".2f"),
            cell(ALL, "g"),
            cell(f"{ALL}, position RMS", ".4f", 1e-3),
            cell(f"{ALL}, rotation median", ".3f"),
            cell(f"{ALL}, step RMS", ".1f"),
            cell(WALLS, ".2f"),
            f"{cell('processor', '.0f')} ({cell('wall', '.1f')})",
        ]


def _run_way(case: Case, way: str, folder: Path) -> dict[str, Any]:
    run, of_way = _our_run(case, folder / "run"), folder / "ways" / way.replace(" ", "_")
    print(f"{case.name}: {way}", flush=True)
    of_way.mkdir(parents=True, exist_ok=True)
    figures_of = our_figures if way == "ours" else partial(stock_figures, way=way)
    figures = figures_of(run, of_way, is_of_right_angles=case.is_tiled_corridor)
    images = len(run.table("import", "frames"))
    return {"capture": case.name, "way": way, "images": images, **now(), "figures": [asdict(f) for f in figures]}


@cache  # one run for all ways of a case
def _our_run(case: Case, folder: Path) -> Run:
    shutil.rmtree(folder, ignore_errors=True)
    return run_stages(case.name, case.folder, folder, case.settings)


@app.command()
def main(
    captures: Annotated[Path, typer.Option(help="Folder with chair, corridor and charuco.")] = CAPTURES,
    only: Annotated[list[str] | None, typer.Option(help="Run this case alone; may be repeated.")] = None,
    work: Annotated[Path, typer.Option(help="Folder for runs and results.")] = Path("build/peers"),
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
) -> None:
    """Run the ways that have no result yet, and write the page."""
    rows = []
    for case in standard_cases(captures):
        folder = work / case.name
        # Positions of several sessions have axes of their own: no priors could be given.
        if case.name not in (only or ("chair", "corridor", "charuco_test-lowres")):
            continue
        rows += [kept(folder / f"{way}.json", partial(_run_way, case, way, folder)) for way in ("ours", *_WAYS)]
    sections = [
        "# Stock COLMAP, told what VIO knows",
        "Written by `python -m benchmarks.peers`, not to be edited; `peers.csv` has every figure. Measured, on captures"
        " of one session each. Stock COLMAP's largest model: its own SIFT, the same images and as many features, an"
        " OPENCV camera, unless another is named, that starts at the logged intrinsics. Held against VIO after a"
        " similarity fit, which with position priors is no independent judge; directions of walls (5th to 95th"
        " percentile) are one, but for a model that is folded. Step: the motion from frame to frame.",
        circumstances_of((row["revision"] for row in rows), (row["date"] for row in rows)),
        markdown_table(_table(rows)),
    ]
    all_figures = [{"capture": r["capture"], "way told": r["way"], **f} for r in rows for f in r["figures"]]
    table = pd.DataFrame(all_figures).drop(columns=["way", "subject"])
    write_page(out, "peers", sections, [list(table), *table.itertuples(index=False)])


if __name__ == "__main__":
    app()
