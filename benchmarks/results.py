"""What every page of docs/results says of its run, and its tables."""

import csv
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from groundwalk.store.checkout import git_revision
from groundwalk.store.cores import machine

CAPTURES = Path("../shared/captures")  # real ones, where there are any
_INSTRUCTION_SETS = ("avx2", "avx_vnni", "avx512f", "avx512_vnni", "amx_int8", "asimddp", "i8mm")


def markdown_table(rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells as a Markdown table, the first its heading."""
    first, *rest = rows
    lines = [first, ["---"] * len(first), *rest]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines)


def side_by_side(cells: Mapping[tuple[str, str], str]) -> Iterable[list[str]]:
    """Rows of a table of figures: a cell by its figure and column, both in the order in which they come first."""
    columns = list(dict.fromkeys(column for _, column in cells))
    yield ["figure", *columns]
    for figure in dict.fromkeys(figure for figure, _ in cells):
        yield [figure, *(cells.get((figure, column), "") for column in columns)]


def write_page(out: Path, name: str, sections: Iterable[str], figures: Iterable[Sequence[object]] = ()) -> None:
    """Write <name>.md of these sections into the folder, and <name>.csv of the figures, the first row its heading."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")
    rows = list(figures)
    if rows:
        with (out / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def kept(path: Path, run: Callable[[], Any]) -> Any:
    """What a case came to, of its file of JSON: it is run, and written there, where there is no such file yet."""
    if not path.is_file():
        outcome = run()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(outcome, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def now() -> dict[str, str]:
    """Revision and date of a case that is written down."""
    return {"revision": git_revision(), "date": f"{datetime.now(UTC):%Y-%m-%d}"}


def busy_machine() -> str:
    """The machine and how busy it is now, for the end of a run."""
    return f"{machine()}, load {os.getloadavg()[0]:.1f} as it ended"


def instruction_sets() -> str:
    """What the processor has for products of integers and of floats, as Linux names it; "unknown" elsewhere."""
    try:
        words = set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    except OSError:
        return "unknown"
    return ", ".join(name for name in _INSTRUCTION_SETS if name in words) or "none of those known"


def circumstances_of(revisions: Iterable[str], dates: Iterable[str]) -> str:
    """The machine, and the revisions and dates of cases that ran one after the other, as sentences."""
    of_cases = ", ".join(sorted(set(revisions))), ", ".join(sorted(set(dates)))
    return f"Machine: {machine()}. Revisions: {of_cases[0]}; dates: {of_cases[1]}."


def circumstances() -> str:
    """Revision, date and machine of this run, in a sentence."""
    return "Revision {revision}, {date}; ".format(**now()) + f"{busy_machine()}."
