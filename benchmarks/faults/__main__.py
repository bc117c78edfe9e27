"""`make test-faults`, or `python -m benchmarks.faults`: all faults, and docs/results/faults.{md,csv}."""

import random
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.faults import artefacts, machine, names, rooms, stops
from benchmarks.faults.case import Case, Outcome
from benchmarks.faults.sandbox import Sandbox, digest, make_sandbox, run_case, workers
from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.store import progress
from groundwalk.store.cli import new_app
from groundwalk.store.settings import STAGES

app = new_app("Faults on purpose, and what became of them.")
WORK = Path("build/faults")


def single_cases(base: Sandbox) -> list[Case]:
    """Every fault that is one command."""
    return [
        *artefacts.cases(base),
        *artefacts.image_cases(),
        *artefacts.output_cases(),
        *names.cases(),
        *machine.cases(8),
        *rooms.cases(base),
    ]


def run_all(base: Sandbox, work: Path, seed: int, only: str, fraction: float) -> list[Outcome]:
    """Outcomes of a fraction of the cases whose kind has `only` in it."""
    chosen = [case for case in single_cases(base) if only in case.kind]
    chosen = random.Random(seed).sample(chosen, max(1, round(fraction * len(chosen)))) if chosen else []
    jobs: list[Callable[[], Iterable[Outcome]]] = [
        partial(_one, case, base, work / f"case{number}", seed) for number, case in enumerate(chosen)
    ]
    if only in "stopped checkpoint damaged":
        count = max(1, round(fraction * 10))
        jobs += [partial(stops.stops, base, work / f"stops-{stage}", stage, count, seed) for stage in STAGES]
    if only in "two at once":
        jobs += [partial(stops.pairs, base, work / f"pairs-{stage}", stage) for stage in STAGES]
    with ThreadPoolExecutor(workers()) as pool:
        ended = pool.map(lambda job: list(job()), jobs)
        return [outcome for outcomes in progress.track(ended, "faults", len(jobs)) for outcome in outcomes]


def _one(case: Case, base: Sandbox, folder: Path, seed: int) -> Iterator[Outcome]:
    yield run_case(case, base, folder, digest(f"{seed} {case.kind} {case.name}"))


@app.command()
def main(
    seed: Annotated[int, typer.Option(help="Seed of all that is random.")] = 0,
    only: Annotated[str, typer.Option(help="Only kinds with this in their name.")] = "",
    fraction: Annotated[float, typer.Option(help="Of the cases, drawn at random.")] = 1.0,
    work: Annotated[Path, typer.Option(help="Where the undisturbed run and its copies lie.")] = WORK,
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
) -> None:
    """Try the faults and write the tables; exits with 1 where a promise was broken."""
    base = make_sandbox(work.absolute() / "base")
    tried = work.absolute() / "tried"
    shutil.rmtree(tried, ignore_errors=True)
    tried.mkdir()
    outcomes = run_all(base, tried, seed, only, fraction)
    _write(outcomes, out, seed, fraction)
    bad = [outcome for outcome in outcomes if outcome.problems]
    for outcome in bad:
        print(f"{outcome.case.kind}: {outcome.case.name} ({outcome.done}): {'; '.join(outcome.problems)}")
    print(f"{len(outcomes)} cases, {len(bad)} with problems, seed {seed}")
    raise typer.Exit(1 if bad else 0)


def _write(outcomes: list[Outcome], out: Path, seed: int, fraction: float) -> None:
    kinds = dict.fromkeys(o.case.kind for o in outcomes)
    rows = [
        ["fault", "cases", "done", "refused", "stopped", "tracebacks", "lost or changed", "outside", "other", "MiB"]
    ]
    for kind in [*kinds, "all"]:
        of_kind = [o for o in outcomes if kind in (o.case.kind, "all")]
        tracebacks = sum(any(p.startswith("traceback") for p in o.problems) for o in of_kind)
        changed, outside = sum(bool(o.changed) for o in of_kind), sum(bool(o.outside) for o in of_kind)
        with_problem = sum(bool(o.problems) for o in of_kind)
        done, refused = (sum(o.status == status for o in of_kind) for status in (0, 2))
        other = with_problem - tracebacks - changed - outside
        counts = [done, refused, len(of_kind) - done - refused, tracebacks, changed, outside, other]
        peak = max(o.peak_bytes for o in of_kind) / 2**20
        rows.append([kind, str(len(of_kind)), *map(str, counts), f"{peak:,.0f}"])
    sections = [
        "# Faults on purpose",
        "Written by `make test-faults` (`python -m benchmarks.faults`), not to be edited; `faults.csv` has every case. "
        "A simulated scene of the smallest size. What is promised: docs/explanation/promises.md.",
        f"{circumstances()} Seed {seed}, {fraction:.0%} of the cases, drawn at random. MiB: largest memory of one "
        "command, with all libraries loaded before.",
        markdown_table(rows),
    ]
    figures: list[list[object]] = [["fault", "case", "done", "exit_status", "peak_mib", "problems"]]
    for o in outcomes:
        words = [text.encode("unicode_escape").decode() for text in (o.case.name, o.done)]
        figures.append([o.case.kind, *words, o.status, round(o.peak_bytes / 2**20), "; ".join(o.problems)])
    write_page(out, "faults", sections, figures)


if __name__ == "__main__":
    app()
