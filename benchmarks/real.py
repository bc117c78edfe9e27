"""Real captures: our ground truth beside stock COLMAP on the same images, against VIO and the figures to reach.

`python -m benchmarks.real` runs chair, corridor and charuco, where `--captures` has them, and any folder named with
`--capture`, one after the other, and writes docs/results/real.md, real.csv and pictures. Cases that ran before keep
their rows, each with its git revision and date. `--stability` resamples them instead and writes real-stability.md.
"""

import hashlib
import json
import shutil
from collections import Counter
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from benchmarks import real_figures
from benchmarks.real_building import floor_figures, wall_figures
from benchmarks.real_figures import Figure, Run
from benchmarks.real_report import Result, Target, draw_case, judge, write_report
from benchmarks.real_stability import stability_of, write_stability
from benchmarks.results import CAPTURES, busy_machine
from benchmarks.stock import stock_cost
from groundwalk.store import UserError
from groundwalk.store.choices import FailureCause
from groundwalk.store.cli import new_app
from groundwalk.store.files import write_json

app = new_app(__doc__ or "")

# What the captures' authors say of the board: "8x11, checker 22 mm, marker 17 mm".
_CHARUCO_BOARD = """[[ruler]]
kind = "charuco"
squares_x = 11
squares_y = 8
square_mm = 22.0
marker_mm = 17.0
dictionary = "DICT_6X6_250"
legacy = true
"""
_ONE_MODEL = Target("models", 1)
_WINDOWS = Target("largest residual to VIO in a window", 0.15, "m")
_BOARD = (
    Target("share of images registered", 98, "%", at_least=True),
    Target(real_figures.WITHIN_BOUNDS, 1),
    Target(real_figures.HELD_OUT, 0.3, "%"),
    Target(real_figures.HELD_OUT_RMS, 1, "mm"),
)
_AGAINST_STOCK = (
    Target(real_figures.POSITION, 1.05, "", way=real_figures.RATIO, every_subject=True),
    Target(f"{real_figures.COMMON}, rotation median", 1.05, "", way=real_figures.RATIO, every_subject=True),
    Target("processor", 0.5, "", way=real_figures.RATIO),
)
_TARGETS = {
    "chair": (
        Target("frames with ground truth", 24, at_least=True),
        Target("class A or B", 24, at_least=True),
        Target("all frames against VIO, position RMS", 5, "mm"),
        Target("reprojection error, mean", 0.42, "px"),
    ),
    "corridor": (Target("frames with ground truth", 70, at_least=True), _ONE_MODEL, _WINDOWS),
    "corridor_all": (
        Target("frames with ground truth", 135, at_least=True),
        Target("class A or B", 100, at_least=True),
        _WINDOWS,
    ),
}


@dataclass(frozen=True)
class Case:
    """A capture folder imported with these settings; whether all walls are at right angles, and the floor's tiles in
    rows of equal length; and the `[[ruler]]` table (TOML) of a printed board in view."""

    name: str
    folder: Path
    settings: tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()
    is_tiled_corridor: bool = False
    board: str = ""


def standard_cases(captures: Path) -> list[Case]:
    """Chair, corridor and charuco, where the folder has them."""
    both = captures / "charuco"
    cases = [
        Case("chair", captures / "chair"),
        Case("corridor", captures / "corridor", is_tiled_corridor=True),
        Case("corridor_all", captures / "corridor", ('sampling="all"',), is_tiled_corridor=True),
        Case("charuco", both, board=_CHARUCO_BOARD),
        *(
            Case(f"charuco_{session.name}", session, board=_CHARUCO_BOARD)
            for session in sorted(both.glob("*/"))
            if session.is_dir()
        ),
    ]
    return [
        replace(case, targets=(*_TARGETS.get(case.name, _BOARD), *_AGAINST_STOCK))
        for case in cases
        if case.folder.is_dir()
    ]


def named_case(folder: Path) -> Case:
    """Any capture folder by default settings, held against stock COLMAP alone."""
    if not folder.is_dir():
        raise UserError("there is no such capture folder", where=folder, do="name a folder with --capture")
    return Case(folder.resolve().name, folder, (), _AGAINST_STOCK)


@app.command()
def main(
    captures: Annotated[
        Path, typer.Option(help="Folder with chair, corridor, charuco; left out if absent.")
    ] = CAPTURES,
    capture: Annotated[list[Path] | None, typer.Option(help="A capture folder of your own; may be repeated.")] = None,
    only: Annotated[list[str] | None, typer.Option(help="Run this case alone; may be repeated.")] = None,
    stability: Annotated[
        bool, typer.Option("--stability", help="Resample each capture instead, and compare the outcomes.")
    ] = False,
    work: Annotated[Path, typer.Option(help="Folder for runs; each case's part of it is emptied first.")] = Path(
        "build/real"
    ),
    out: Annotated[Path, typer.Option(help="Folder for the tables and pictures.")] = Path("docs/results"),
) -> None:
    """Run the cases and write their tables; exits with 1 where a figure is missed."""
    cases = [*standard_cases(captures), *(named_case(folder) for folder in capture or [])]
    names = [case.name for case in cases]
    if unknown := sorted(set(only or []) - set(names)):
        raise UserError("there is no such case", found=", ".join(unknown), expected=f"some of {', '.join(names)}")
    if len(set(names)) < len(names):
        raise UserError("two captures have the same name", found=", ".join(names), do="rename one of the folders")
    kept, is_met = work / ("stability" if stability else "results"), True
    kept.mkdir(parents=True, exist_ok=True)
    for case in cases:
        if only and case.name not in only:
            continue
        print(f"{case.name}: {'resamplings of ' if stability else ''}{case.folder}", flush=True)
        # After each case: a run that is stopped keeps what it has.
        if stability:
            resampled = stability_of(case.name, case.folder, case.settings, work / "resampled" / case.name)
            resampled.to_csv(kept / f"{case.name}.csv", index=False)
            is_met &= bool(resampled["agrees"].all())
            write_stability(out, pd.concat(map(pd.read_csv, sorted(kept.glob("*.csv"))), ignore_index=True))
        else:
            result = run_case(case, work / case.name, out)
            write_json(kept / f"{case.name}.json", asdict(result))
            is_met &= all(judge(result.figures, target)[1] for target in result.targets)
            write_report(out, [_loaded(path) for path in sorted(kept.glob("*.json"))])
    if not is_met:
        raise typer.Exit(1)


def _loaded(path: Path) -> Result:
    content = json.loads(path.read_text(encoding="utf-8"))
    figures = [Figure(**figure) for figure in content["figures"]]
    return Result(**content | {"figures": figures, "targets": [Target(**target) for target in content["targets"]]})


def run_case(case: Case, folder: Path, pictures: Path) -> Result:
    """Run a case and stock COLMAP beside it, in `folder`, which is emptied; draw its picture."""
    shutil.rmtree(folder, ignore_errors=True)
    run = real_figures.run_stages(case.name, case.folder, folder, case.settings)
    digest, revision = "", ""
    if run.has("import"):
        print(f"  {case.name}: stock COLMAP", flush=True)
        run.costs[real_figures.STOCK] = stock_cost(case.name, run.profile, run.root, run.stock_folder)
        draw_case(pictures / f"real_{case.name}.png", f"{case.name}: {run.verdict}", real_figures.paths_of(run))
        images = "".join(sorted(run.table("import", "frames")["image_sha256"]))
        digest, revision = hashlib.sha256(images.encode()).hexdigest()[:12], run.manifest("import")["git_revision"]
    figures = real_figures.figures_of(run)
    failed, verdict = _failed_checks(run), run.verdict  # without the board
    if run.has("align"):
        figures += real_figures.depth_figures(run.table("align", "depth_agreement"))
        if case.is_tiled_corridor:
            figures += wall_figures(run, pictures / f"real_{case.name}_walls.png") + floor_figures(run)
        if case.board:
            figures += real_figures.board_figures(
                *(_align_with(case.board, run, use_for_scale=use) for use in (False, True))
            )
    return Result(
        case=case.name,
        capture=case.folder.resolve().name,
        settings=list(case.settings),
        inputs=digest,
        revision=revision,
        date=datetime.now(UTC).strftime("%Y-%m-%d"),
        machine=busy_machine(),
        verdict=verdict,
        failed_checks=failed,
        figures=figures,
        targets=list(case.targets),
    )


def _failed_checks(run: Run) -> list[str]:
    """Cause, name and number of align's failed checks, in the order in which a cause says most."""
    if not run.has_table("align", "checks"):
        return []
    checks = run.table("align", "checks")
    failed = checks[checks["status"] == "failed"]
    counts = Counter(zip(failed["cause"], failed["check"], strict=True))
    priority = list(FailureCause)
    rows = sorted(counts.items(), key=lambda row: (priority.index(FailureCause(row[0][0])), row[0][1]))
    return [f"{cause} ({check}, {count})" for (cause, check), count in rows]


def _align_with(board: str, run: Run, *, use_for_scale: bool) -> pd.DataFrame:
    """The rulers' table after align once more with the case's board, in place: costs and checks of the case are those
    without it."""
    scene = run.root.root / "scenes" / f"{run.scene}.toml"
    scene.parent.mkdir(exist_ok=True)
    scene.write_text(f"{board}use_for_scale = {str(use_for_scale).lower()}\n", encoding="utf-8")
    log = run.root.root / "align_board.log"
    status, _ = real_figures.run_stage(run, "align", log)
    if status:
        raise UserError("align failed with the board", where=log, found=f"exit status {status}")
    return run.table("align", "rulers")


if __name__ == "__main__":
    app()
