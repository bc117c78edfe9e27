"""Two runs are compared column by column, under the names that each has."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from typer.testing import CliRunner

from benchmarks.compare_runs import app

RENAMES = """
[names]
"align.gate" = "align.checks"
"align.checks.verdict" = "align.checks.status"
"align.figures.seen" = "align.figures.count"

[values."align.checks.status"]
"bad" = "failed"

[may_differ]
"*.seconds" = "a time"
"""


def run(folder: Path, table: str, columns: dict[str, list[Any]], figures: dict[str, float]) -> Path:
    stage = folder / "align"
    stage.mkdir(parents=True)
    pq.write_table(pa.table(columns), stage / f"{table}.parquet")
    (stage / "manifest.json").write_text(json.dumps({"figures": figures}))
    return folder


def compare(older: Path, newer: Path, tmp_path: Path) -> tuple[int, str]:
    renames = tmp_path / "renames.toml"
    renames.write_text(RENAMES)
    done = CliRunner().invoke(app, [str(older), str(newer), "--renames", str(renames)])
    return done.exit_code, done.stdout


def test_renamed_values_are_equal_and_others_are_not(tmp_path: Path) -> None:
    values: dict[str, list[Any]] = {"x": [1.0, float("nan")], "cov": [[0.1], None], "seconds": [1.0, 2.0]}
    older = run(tmp_path / "a", "gate", {**values, "verdict": ["bad", None]}, {"seen": 2})
    renamed = {**values, "seconds": [3.0, 2.0], "status": ["failed", None]}
    code, text = compare(older, run(tmp_path / "b", "checks", renamed, {"count": 2}), tmp_path)
    assert code == 0 and "4 columns and figures equal, 1 may differ, 0 differ" in text
    changed = {**renamed, "x": [1.0 + 1e-15, float("nan")]}
    code, text = compare(older, run(tmp_path / "c", "checks", changed, {"more": 2}), tmp_path)
    assert code == 1 and "different: align.checks.x: 1 of 2 rows" in text and "largest difference 1.11e-15" in text
    assert "only in" in text and "align.figures.more" in text and "align.figures.count" in text
