"""A campaign disturbed by kills, and planning of many scenes: `python -m benchmarks.campaign` (`make bench-campaign`).

Simulated captures of profile tiny, import to align. The same scenes are run twice: once undisturbed, once with jobs and
Snakemake itself killed (SIGKILL) at random times, and the command given again until all is done. Every Parquet table of
both must hold the same bytes. Writes docs/results/campaign.md.
"""

import contextlib
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import psutil  # type: ignore[import-untyped]
import typer

from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.files import hash_files

app = new_app(__doc__ or "")
_PROFILE, _PLACES = "tiny", ("Church", "Office", "Bar", "Square")
_LONGEST_S = 3 * 3600.0


def _table(folder: Path, scenes: int) -> Path:
    """A CSV of so many scenes of the simulated places, which are made once."""
    captures = DataRoot(folder / "simulated")
    for place in _PLACES:
        command = ["simulate", "--scene", place, "--profile", _PROFILE, "--data", captures.root]
        subprocess.run([sys.executable, "-m", "groundwalk", *map(str, command)], check=True, stderr=subprocess.DEVNULL)
    rows = [(f"S{i:05d}", captures.captures(_PLACES[i % len(_PLACES)]).resolve(), "align") for i in range(scenes)]
    table = folder / f"scenes{scenes}.csv"
    pd.DataFrame(rows, columns=["scene", "captures", "until"]).to_csv(table, index=False)
    return table


def _started(table: Path, data: Path, *more: str) -> psutil.Popen:
    """The command of a campaign."""
    command = [sys.executable, "-m", "groundwalk", "campaign", table, "--profile", _PROFILE, "--data", data, *more]
    return psutil.Popen([*map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _planning(table: Path, data: Path) -> tuple[float, float]:
    """Seconds of a campaign's command that starts no job (a dry run of Snakemake's), and MiB of its largest process."""
    start, process, peak = time.monotonic(), _started(table, data, "--", "-n"), 0
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            peak = max(peak, *(one.memory_info().rss for one in (process, *process.children(recursive=True))))
        time.sleep(0.1)
    # 1, as nothing is done.
    if process.returncode != 1 or not (data / "campaigns" / table.stem / "plan.json").is_file():
        raise RuntimeError(f"the dry run ended with {process.returncode}")
    return time.monotonic() - start, peak / 2**20


def _run(table: Path, data: Path, jobs: int, schedulers: int, every_s: float) -> dict[str, float]:
    """Run a campaign to its end with so many kills of jobs and of Snakemake, one each `every_s` seconds on average. How
    busy cores are is the whole machine's, so that no process is missed: other programs count, too."""
    rng, start, before = np.random.default_rng(0), time.monotonic(), psutil.cpu_times()
    left = list(rng.permutation(["job"] * jobs + ["scheduler"] * schedulers))
    commands = 0
    while True:
        commands += 1
        process = _started(table, data)
        due = time.monotonic() + rng.exponential(every_s)
        while process.poll() is None:
            time.sleep(0.2)
            if left and time.monotonic() > due and _kill(process, left[-1]):
                left.pop()
                due = time.monotonic() + rng.exponential(every_s)
        if process.returncode == 0:
            break
        if time.monotonic() - start > _LONGEST_S:
            raise RuntimeError("the campaign doesn't end")
    spent = [now - then for now, then in zip(psutil.cpu_times(), before, strict=True)]
    idle = sum(s for name, s in zip(before._fields, spent, strict=True) if name in ("idle", "iowait"))
    busy = 100 * (1 - idle / sum(spent))
    result = {
        "seconds": time.monotonic() - start,
        "cores busy (%)": busy,
        "commands": commands,
        "kills left": len(left),
    }
    print(", ".join(f"{name}: {value:,.0f}" for name, value in result.items()), flush=True)
    return result


def _kill(campaign: psutil.Process, what: str) -> bool:
    """Kill a stage, or Snakemake with all that it runs; False where there is none at the moment."""
    try:
        below = campaign.children(recursive=True)
        lines = {process: " ".join(process.cmdline()) for process in below}
    except psutil.Error:
        return False
    words = "-m groundwalk." if what == "job" else "-m snakemake"
    chosen = [process for process, line in lines.items() if words in line and "bash" not in line]
    for process in (chosen[0].children(recursive=True) if chosen and what == "scheduler" else []) + chosen[:1]:
        try:
            process.send_signal(signal.SIGKILL)
        except psutil.NoSuchProcess:
            continue
    return bool(chosen)


def _tables(data: Path) -> dict[str, str]:
    """Hashes of all Parquet tables of all runs."""
    runs = data / "runs"
    return hash_files(runs, sorted(runs.glob("*/*/*/*.parquet")))


@app.command()
def main(
    scenes: Annotated[int, typer.Option(help="Scenes that are run.")] = 200,
    kills: Annotated[int, typer.Option(help="Jobs that are killed; one in ten as many times Snakemake.")] = 20,
    planned: Annotated[str, typer.Option(help="Numbers of scenes to plan, joined by commas.")] = "1000,10000",
    work: Annotated[Path, typer.Option(help="Folder for the data, an empty one.")] = Path("build/campaign"),
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("docs/results"),
) -> None:
    """Run the campaigns and write the page."""
    work.mkdir(parents=True)
    made = [["scenes", "until the first job would start (s)", "MiB"]]
    for count in map(int, planned.split(",")):
        seconds, mib = _planning(_table(work, count), work / f"planned{count}")
        made.append([f"{count:,}", f"{seconds:.1f}", f"{mib:.0f}"])
    table = _table(work, scenes)
    clean = _run(table, work / "clean", 0, 0, 1.0)
    again = _run(table, work / "clean", 0, 0, 1.0)
    disturbed = _run(table, work / "disturbed", kills, kills // 10, 0.8 * clean["seconds"] / max(1, kills * 1.1))
    expected, found = _tables(work / "clean"), _tables(work / "disturbed")
    other = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    (work / "result.json").write_text(json.dumps({"clean": clean, "disturbed": disturbed, "other": other}, indent=1))
    runs = [["", "undisturbed", "given again", "with kills"]]
    for name in clean:
        runs.append([name, *(f"{run[name]:,.0f}" for run in (clean, again, disturbed))])
    sections = [
        "# Campaigns",
        "Written by `make bench-campaign` (`python -m benchmarks.campaign`), not to be edited. Simulated places "
        f"({', '.join(_PLACES)}), profile {_PROFILE}, import to align and report.",
        circumstances(),
        f"## {scenes} scenes, {kills} jobs and {kills // 10} times Snakemake killed",
        markdown_table(runs),
        f"Of {len(expected)} Parquet tables {len(other)} differ between the two{': ' if other else ''}"
        f"{', '.join(other[:8])}.",
        "## Planning",
        markdown_table(made),
    ]
    write_page(out, "campaign", sections)


if __name__ == "__main__":
    app()
