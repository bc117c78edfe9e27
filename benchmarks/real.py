"""Real captures: our ground truth beside stock COLMAP on the same images, against VIO and the figures to reach.

`python -m benchmarks.real` runs chair, corridor and charuco, where `--captures` has them, and any folder named with
`--capture`, one after the other, and writes docs/results/real.md, real.csv and pictures. Cases that ran before keep
their rows, each with its git revision and date. `--stability` resamples them instead and writes real-stability.md.
Recordings without images have nothing for SfM (`make bench-import` and `make bench-fusion` use them).
"""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.real_cases import Case, Result, judge, named_case, run_case, standard_cases
from benchmarks.real_report import write_report, write_stability
from benchmarks.real_stability import load, save, stability_of
from groundwalk.store import UserError
from groundwalk.store.cli import new_app

app = new_app(__doc__ or "")

_STABILITY = ".stability.json"


@app.command()
def main(
    captures: Annotated[Path, typer.Option(help="Folder with chair, corridor and charuco; left out if absent.")] = Path(
        "../shared/captures"
    ),
    capture: Annotated[list[Path] | None, typer.Option(help="A capture folder of your own; may be repeated.")] = None,
    only: Annotated[list[str] | None, typer.Option(help="Run this case alone; may be repeated.")] = None,
    stability: Annotated[
        bool, typer.Option("--stability", help="Resample each capture instead, and compare the verdicts.")
    ] = False,
    work: Annotated[Path, typer.Option(help="Folder for runs; each case's part of it is emptied first.")] = Path(
        "build/real"
    ),
    out: Annotated[Path, typer.Option(help="Folder for the tables and pictures.")] = Path("docs/results"),
) -> None:
    """Run the cases and write their tables; exits with 1 where a figure is missed."""
    chosen = _cases(captures, capture or [], only or [])
    kept = work / "results"
    kept.mkdir(parents=True, exist_ok=True)
    met = True
    for case in chosen:
        print(f"{case.name}: {'resamplings of ' if stability else ''}{case.folder}", flush=True)
        if stability:
            tried = stability_of(case, work / "stability")
            save(tried, kept / f"{case.name}{_STABILITY}")
            met &= all(one.agrees for one in tried)
        else:
            result = run_case(case, work, out)
            result.save(kept)
            met &= all(judge(result.figures, target).met for target in result.targets)
        # After each case: a run that is stopped keeps what it has.
        page = _write_stability(kept, out) if stability else _write(kept, out)
    if chosen:
        print(page.read_text(encoding="utf-8"))
    if not met:
        raise typer.Exit(1)


def _cases(captures: Path, named: list[Path], only: list[str]) -> list[Case]:
    cases = [*standard_cases(captures), *(named_case(folder) for folder in named)]
    if not cases:
        print(f"left out: no captures in {captures}; name one with --captures or --capture")
    names = [case.name for case in cases]
    if unknown := sorted(set(only) - set(names)):
        raise UserError("there is no such case", found=", ".join(unknown), expected=f"some of {', '.join(names)}")
    if len(set(names)) < len(names):
        raise UserError("two captures have the same name", found=", ".join(names), do="rename one of the folders")
    return [case for case in cases if not only or case.name in only]


def _write(kept: Path, out: Path) -> Path:
    """The report of all cases that ran, the latest run of each."""
    paths = sorted(path for path in kept.glob("*.json") if not path.name.endswith(_STABILITY))
    write_report(out, [Result.load(path) for path in paths])
    return out / "real.md"


def _write_stability(kept: Path, out: Path) -> Path:
    """The report of all cases that were resampled."""
    write_stability(out, [one for path in sorted(kept.glob(f"*{_STABILITY}")) for one in load(path)])
    return out / "real-stability.md"


if __name__ == "__main__":
    app()
