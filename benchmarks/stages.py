"""Wall time, processor time, peak memory and bytes of each stage: `python -m benchmarks.stages --scene Church`.

Every stage runs once, in a data folder of its own, as its own process. Beside the seconds stand two yardsticks taken
in the same run, so that figures from different machines can be held against each other: how often the stage could have
decoded every image of the capture on one core meanwhile, and the share of the cores that it kept busy.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import typer

from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app

MODULES = {
    "import": "groundwalk.capture_import",
    "sfm": "groundwalk.sfm",
    "align": "groundwalk.alignment",
    "localise": "groundwalk.localisation",
    "train": "groundwalk.training",
    "fuse": "groundwalk.fusion",
    "report": "groundwalk.reports",
}

app = new_app(__doc__ or "")


@dataclass(frozen=True)
class Cost:
    """What one command cost."""

    wall_s: float
    cpu_s: float
    peak_mib: float
    written_mib: float


def measure(command: list[str], folder: Path) -> Cost:
    """Run a command to its end; `folder` is where it writes. UserError when it fails."""
    status, cost = run_timed(command, folder)
    if status:
        raise UserError("a stage failed", where=" ".join(command), found=f"exit status {status}")
    return cost


def run_timed(command: list[str], folder: Path, log: Path | None = None) -> tuple[int, Cost]:
    """Run a command to its end: its exit status and what it cost. `folder` is where it writes; what it prints goes to
    `log`, where there is one. Processor seconds are the whole process tree's, memory is its largest process's."""
    start = time.monotonic()
    with log.open("wb") if log else contextlib.nullcontext() as output:
        waiting = [sys.executable, "-m", "benchmarks.process_tree", *command]
        process = subprocess.Popen(waiting, stdout=output, stderr=subprocess.STDOUT if log else None)
        _, status, usage = os.wait4(process.pid, 0)
    wall = time.monotonic() - start
    per_mib = 2**20 if sys.platform == "darwin" else 2**10
    written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.exists() else 0
    cost = Cost(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / per_mib, written / 2**20)
    return os.waitstatus_to_exitcode(status), cost


def decode_seconds(captures: Path) -> tuple[float, int]:
    """Seconds to decode every JPEG and PNG of a capture folder on one core, and how many there are."""
    images = [path for path in sorted(captures.rglob("*")) if path.suffix.lower() in (".jpg", ".jpeg", ".png")]
    cv2.setNumThreads(1)
    start = time.monotonic()
    for path in images:
        cv2.imread(str(path), cv2.IMREAD_COLOR)
    return time.monotonic() - start, len(images)


@app.command()
def main(
    scene: SceneOption,
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
    keep: Annotated[Path | None, typer.Option(help="Work in this empty folder and keep it.")] = None,
) -> None:
    """Run and measure every stage; prints a Markdown table."""
    with tempfile.TemporaryDirectory() as temporary:
        root = DataRoot(keep or Path(temporary))
        captures = root.captures(scene)
        captures.parent.mkdir(parents=True, exist_ok=True)
        arguments = ["--scene", scene, "--profile", profile, "--data", str(root.root)]
        costs: dict[str, Cost] = {}
        given = DataRoot(data).captures(scene)
        if given.is_dir():
            captures.symlink_to(given.resolve(), target_is_directory=True)
        else:
            costs["simulate"] = measure([sys.executable, "-m", "groundwalk.simulation", *arguments], captures)
        for stage, module in MODULES.items():
            command = [sys.executable, "-m", module, *arguments]
            costs[stage] = measure(command, root.run(profile, scene, stage))
        yardstick, images = decode_seconds(captures.resolve())
    cores = os.cpu_count() or 1
    print(f"\n{scene}, profile {profile}, {images} images, {cores} cores; decoding them once: {yardstick:.2f} s\n")
    print("| stage | wall s | processor s | cores busy | times decoding | peak MiB | written MiB |")
    print("|---|---|---|---|---|---|---|")
    for stage, cost in costs.items():
        print(
            f"| {stage} | {cost.wall_s:.1f} | {cost.cpu_s:.1f} | {cost.cpu_s / cost.wall_s / cores:.0%} "
            f"| {cost.wall_s / yardstick:.1f} | {cost.peak_mib:.0f} | {cost.written_mib:.1f} |"
        )
    total = sum(cost.wall_s for cost in costs.values())
    print(f"| all | {total:.1f} | {sum(c.cpu_s for c in costs.values()):.1f} | | {total / yardstick:.1f} | | |")


if __name__ == "__main__":
    app()
