"""Commands run to their end, with what they cost: wall time, processor time, peak memory, bytes written."""

import contextlib
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from groundwalk.store import UserError


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
