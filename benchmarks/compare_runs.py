"""Whether two runs of a scene have the same values: `python -m benchmarks.compare_runs <older> <newer>`, each a folder
such as `data/runs/tiny/Church`.

Every column of every table is compared, and every figure of the manifests, bit for bit. `compare_runs.toml` says what
was renamed between the two, and what may differ and why. Exits with 1 where anything else differs or is missing.
"""

import json
import tomllib
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pyarrow.parquet as pq
import typer

from groundwalk.artefacts import UserError
from groundwalk.artefacts.cli import new_app

app = new_app(__doc__ or "")
DEFAULT_RENAMES = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True, kw_only=True)
class Renames:
    """What is called otherwise in the newer run: `names` of tables, columns and figures (`stage.table`,
    `stage.table.column`, `stage.figures.name`, older to newer), `values` of text columns (by their newer name), and
    patterns of newer names that may differ, with the reason."""

    names: dict[str, str]
    values: dict[str, dict[str, str]]
    may_differ: dict[str, str]

    @classmethod
    def load(cls, path: Path) -> "Renames":
        return cls(**{"names": {}, "values": {}, "may_differ": {}, **tomllib.loads(path.read_text(encoding="utf-8"))})

    def newer(self, table: str, column: str) -> str:
        """The newer name `stage.table.column` of an older run's column."""
        table = self.names.get(table, table)
        return self.names.get(f"{table}.{column}", f"{table}.{column}")

    def reason(self, name: str) -> str | None:
        """Why a column or figure may differ, or None."""
        return next((why for pattern, why in self.may_differ.items() if fnmatch(name, pattern)), None)


NOTHING = Renames(names={}, values={}, may_differ={})


def run_values(run: Path, renames: Renames = NOTHING) -> dict[str, list[Any]]:
    """All columns (`stage.table.column`) and figures (`stage.figures.name`) of a run by their newer names; a figure is
    a list of one."""
    values = {}
    for path in sorted(run.glob("*/*.parquet")):
        table = pq.read_table(path)
        for column in table.column_names:
            name = renames.newer(f"{path.parent.name}.{path.stem}", column)
            choices = renames.values.get(name)
            rows = table[column].to_pylist()
            # A value that was renamed to an empty text is null.
            values[name] = [choices.get(row, row) or None for row in rows] if choices else rows
    for path in sorted(run.glob("*/manifest.json")):
        for figure, value in json.loads(path.read_text(encoding="utf-8"))["figures"].items():
            values[renames.newer(f"{path.parent.name}.figures", figure)] = [value]
    if not values:
        raise UserError("a run has no tables", where=run, expected="a folder such as data/runs/tiny/Church")
    return values


def difference(older: list[Any], newer: list[Any]) -> str:
    """How two columns differ; empty where they are equal (NaN equals NaN)."""
    if repr(older) == repr(newer):
        return ""
    if len(older) != len(newer):
        return f"{len(older)} rows, now {len(newer)}"
    rows = [i for i, (a, b) in enumerate(zip(older, newer, strict=True)) if repr(a) != repr(b)]
    text = f"{len(rows)} of {len(older)} rows, first {older[rows[0]]!r:.80}, now {newer[rows[0]]!r:.80}"
    try:
        largest = np.nanmax(np.abs(np.array(older, float) - np.array(newer, float)))
    except (TypeError, ValueError):
        return text
    return f"{text}; largest difference {largest:.3g}"


@app.command()
def compare(
    older: Annotated[Path, typer.Argument(help="The run before, a folder such as data/runs/tiny/Church.")],
    newer: Annotated[Path, typer.Argument(help="The run after, of the same stages.")],
    renames: Annotated[Path, typer.Option(help="What was renamed, and what may differ (TOML).")] = DEFAULT_RENAMES,
) -> None:
    """Compare two runs of a scene value by value."""
    between = Renames.load(renames)
    before, after = run_values(older, between), run_values(newer)
    stages = {name.split(".")[0] for name in after}
    before = {name: rows for name, rows in before.items() if name.split(".")[0] in stages}
    unlike = {name: f"only in {newer if name in after else older}" for name in sorted(before.keys() ^ after.keys())}
    unlike |= {name: text for name in before.keys() & after.keys() if (text := difference(before[name], after[name]))}
    wrong = [name for name in unlike if between.reason(name) is None]
    for name in sorted(unlike):
        print(
            f"{'different' if name in wrong else 'may differ'}: {name}: {unlike[name]} ({between.reason(name) or '-'})"
        )
    equal = len(before.keys() & after.keys() - unlike.keys())
    print(f"{equal} columns and figures equal, {len(unlike) - len(wrong)} may differ, {len(wrong)} differ")
    if wrong:
        raise typer.Exit(1)


if __name__ == "__main__":
    app()
