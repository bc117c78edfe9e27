"""The captures of the real benchmark, what each must reach, and a run of one by our stages and stock COLMAP."""

import hashlib
import json
import os
import platform
import shutil
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.real_figures import (
    CRASHED,
    OURS,
    POSITION,
    RATIO,
    STAGES,
    STOCK,
    Figure,
    Finished,
    Verdict,
    figures_of,
    paths_of,
    verdict_of,
)
from benchmarks.real_floor import floor_figures
from benchmarks.real_plots import draw_case
from benchmarks.real_scale import HELD_OUT, HELD_OUT_RMS, WITHIN_BOUNDS, board_figures, depth_figures
from benchmarks.real_walls import wall_figures
from benchmarks.stages import Cost, run_timed
from benchmarks.stock import stock_command
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import DataRoot, UserError
from groundwalk.store.choices import FailureCause
from groundwalk.store.files import write_json
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.settings import resolve_settings
from groundwalk.store.tables import read_table

PROFILE = "demo"


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
        unit = f" {self.unit}" if self.unit else ""
        return f"{'≥' if self.at_least else '≤'} {self.limit:g}{unit}"


@dataclass(frozen=True)
class Judged:
    """A target, the worst value of its figure, and whether it is met; a figure that isn't there misses it."""

    target: Target
    value: float | None
    met: bool


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


@dataclass(frozen=True)
class Result:
    """What the tables are written from: one case, when and where it ran, and what came out."""

    case: str
    capture: str
    settings: list[str]
    seed: int
    inputs: str
    """The first digits of the sha256 of all images' sha256."""
    revision: str
    date: str
    machine: str
    system_load: float
    """Mean number of processes that were busy in the minute before it began."""
    verdict: Verdict
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

    def save(self, folder: Path) -> None:
        """Write it whole or not at all."""
        write_json(folder / f"{self.case}.json", asdict(self))

    @classmethod
    def load(cls, path: Path) -> "Result":
        """What `save` wrote."""
        content = json.loads(path.read_text(encoding="utf-8"))
        content["verdict"] = Verdict(**content["verdict"])
        content["figures"] = [Figure(**figure) for figure in content["figures"]]
        content["targets"] = [Target(**target) for target in content["targets"]]
        return cls(**content)


def judge(figures: Sequence[Figure], target: Target) -> Judged:
    """Hold a target against the worst of the figures that it names."""
    values = [
        figure.value
        for figure in figures
        if (figure.name, figure.way) == (target.name, target.way) and (target.every_subject or not figure.subject)
    ]
    if not values or not np.isfinite(values).all():
        return Judged(target, None, False)
    worst = min(values) if target.at_least else max(values)
    return Judged(target, worst, worst >= target.limit if target.at_least else worst <= target.limit)


_AGAINST_STOCK = (
    Target(POSITION, 1.05, "", way=RATIO, every_subject=True),
    Target("common frames against VIO, rotation median", 1.05, "", way=RATIO, every_subject=True),
    Target("processor", 0.5, "", way=RATIO),
)
_ACCEPTED = Target("accepted", 1, at_least=True)
_SCALE = (Target(WITHIN_BOUNDS, 1), Target(HELD_OUT, 0.3, "%"), Target(HELD_OUT_RMS, 1, "mm"))
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
_WINDOWS = Target("largest residual to VIO in a window", 0.15, "m")


def standard_cases(captures: Path) -> list[Case]:
    """Issue 15's captures, where the folder has them."""
    chair = (
        _ACCEPTED,
        Target("frames with ground truth", 24, at_least=True),
        Target("class A or B", 24, at_least=True),
        Target("all frames against VIO, position RMS", 5, "mm"),
        Target("reprojection error, mean", 0.42, "px"),
    )
    corridor = (
        _ACCEPTED,
        Target("frames with ground truth", 70, at_least=True),
        Target("models", 1),
        _WINDOWS,
    )
    corridor_all = (
        _ACCEPTED,
        Target("frames with ground truth", 135, at_least=True),
        Target("class A or B", 100, at_least=True),
        _WINDOWS,
    )
    both, share = captures / "charuco", Target("share of images registered", 98, "%", at_least=True)
    cases = [
        Case("chair", captures / "chair", (), chair),
        Case("corridor", captures / "corridor", (), corridor, is_tiled_corridor=True),
        Case("corridor_all", captures / "corridor", ('sampling="all"',), corridor_all, is_tiled_corridor=True),
        Case("charuco", both, (), (_ACCEPTED, share, *_SCALE), board=_CHARUCO_BOARD),
        *(
            Case(f"charuco_{session.name}", session, (), (_ACCEPTED, share, *_SCALE), board=_CHARUCO_BOARD)
            for session in sorted(both.glob("*/"))
            if session.is_dir()
        ),
    ]
    return [replace(case, targets=(*case.targets, *_AGAINST_STOCK)) for case in cases if case.folder.is_dir()]


def named_case(folder: Path) -> Case:
    """Any capture folder by default settings, held against stock COLMAP alone."""
    if not folder.is_dir():
        raise UserError("there is no such capture folder", where=folder, do="name a folder with --capture")
    return Case(folder.resolve().name, folder, (), _AGAINST_STOCK)


def run_stages(
    case: Case,
    root: DataRoot,
    import_settings: Sequence[str] = (),
    seed: int = 0,
    only: Sequence[str] = tuple(STAGES),
) -> tuple[dict[str, Cost], Verdict]:
    """Import, sfm and align of a case in an empty data folder, each a process of its own, until one refuses its input;
    what each cost, and the verdict. What they print is beside, in `<stage>.log`."""
    captures = root.captures(case.name)
    captures.parent.mkdir(parents=True, exist_ok=True)
    captures.symlink_to(case.folder.resolve(), target_is_directory=True)
    costs, statuses, logs = dict[str, Cost](), dict[str, int](), dict[str, str]()
    for stage in only:
        sets = (*case.settings, *import_settings) if stage == "import" else ()
        log = root.root / f"{stage}.log"
        statuses[stage], costs[stage] = _run_stage(case.name, root, stage, log, seed, sets)
        logs[stage] = log.read_text(encoding="utf-8", errors="replace")
        if statuses[stage]:
            break
    run = Finished(case.name, PROFILE, root, Path(), costs, Verdict(CRASHED))
    return costs, verdict_of(statuses, logs, [cause for cause, _, _ in failed_checks(run)])


def _run_stage(
    scene: str, root: DataRoot, stage: str, log: Path, seed: int = 0, settings: Sequence[str] = ()
) -> tuple[int, Cost]:
    """Exit status and cost of a stage."""
    command = [sys.executable, "-m", STAGES[stage], "--scene", scene, "--profile", PROFILE, "--data", str(root.root)]
    command += ["--seed", str(seed), *(word for setting in settings for word in ("--set", setting))]
    return run_timed(command, root.run(PROFILE, scene, stage), log)


def failed_checks(run: Finished) -> list[tuple[str, str, int]]:
    """Cause, name and number of align's failed checks, in the order in which a cause says most."""
    if not run.has_table("align", "checks"):
        return []
    checks = run.table("align", "checks")
    failed = checks[checks["status"] == "failed"]
    rows = [(*key, count) for key, count in Counter(zip(failed["cause"], failed["check"], strict=True)).items()]
    priority = list(FailureCause)
    return sorted(rows, key=lambda row: (priority.index(FailureCause(row[0])), row[1]))


def run_case(case: Case, out: Path, pictures: Path) -> Result:
    """Run a case and stock COLMAP beside it, below `out`/<case>, which is emptied; draw its picture."""
    folder, load = out / case.name, os.getloadavg()[0]
    shutil.rmtree(folder, ignore_errors=True)
    root = DataRoot(folder / "data")
    root.root.mkdir(parents=True)
    costs, verdict = run_stages(case, root)
    run = Finished(case.name, PROFILE, root, folder / "stock", costs, verdict)
    if run.has("import"):
        print(f"  {case.name}: stock COLMAP", flush=True)
        settings = resolve_settings(SfmSettings, "sfm", root, PROFILE, case.name, [])
        command = stock_command(case.name, PROFILE, root, run.stock_folder, settings, "opencv")
        status, costs[STOCK] = run_timed(command, run.stock_folder, folder / "stock.log")
        if status:
            raise UserError("stock COLMAP failed", where=folder / "stock.log", found=f"exit status {status}")
        draw_case(pictures / f"real_{case.name}.png", case.name, str(verdict), paths_of(run))
    figures = figures_of(run)
    if case.is_tiled_corridor and run.has("align"):
        figures += wall_figures(run, pictures / f"real_{case.name}_walls.png") + floor_figures(run)
    if run.has("align"):
        figures += depth_figures(run.table("align", "depth_agreement"))
    failed = [f"{cause} ({check}, {count})" for cause, check, count in failed_checks(run)]
    if case.board and run.has("align"):
        figures += board_figures(*(_align_with(case, run, use_for_scale=use) for use in (False, True)))
    return Result(
        case.name,
        case.folder.resolve().name,
        list(case.settings),
        0,
        *_provenance(run),
        datetime.now(UTC).strftime("%Y-%m-%d"),
        f"{processor_name()}, {os.cpu_count()} cores, {platform.system()}",
        round(load, 1),
        verdict,
        failed,
        figures,
        list(case.targets),
    )


def _align_with(case: Case, run: Finished, *, use_for_scale: bool) -> pd.DataFrame:
    """The rulers' table after align once more with the case's board, in place: costs and checks of the case are those
    without it."""
    scene = run.root.root / "scenes" / f"{case.name}.toml"
    scene.parent.mkdir(exist_ok=True)
    scene.write_text(f"{case.board}use_for_scale = {str(use_for_scale).lower()}\n", encoding="utf-8")
    log = run.root.root / "align_board.log"
    status, _ = _run_stage(case.name, run.root, "align", log)
    if status:
        raise UserError("align failed with the board", where=log, found=f"exit status {status}")
    return run.table("align", "rulers")


def _provenance(run: Finished) -> tuple[str, str]:
    """A digest of the images, and the git revision."""
    if not run.has("import"):
        return "", ""
    folder = run.folder("import")
    images = read_table(folder / "frames.parquet", schema("import", "frames"))["image_sha256"]
    digest = hashlib.sha256("".join(sorted(images)).encode()).hexdigest()[:12]
    return digest, str(load_manifest(folder)["git_revision"])


def processor_name() -> str:
    """The processor's model as the system tells it."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
