"""docs/reference/tables.md, made from the schemas so that it can't fall behind them."""

from collections.abc import Iterator

from groundwalk.store.schemas import Column, TableSchema, all_tables
from groundwalk.store.text import markdown_table

_HEAD = """# Tables

What each stage leaves in `data/runs/<profile>/<scene>/<stage>/`: the tables below as Parquet, `recording.rrd` (a view
of them, with its blueprint) and `manifest.json` (inputs with hashes, resolved settings, versions, seed, git revision,
machine, seconds a step, figures). Parquet is the truth; each column carries its unit, frame and meaning as metadata.
A table's version is `major.minor`; a reader refuses another major.

A pose group is seven columns: `map_cam_*` stands for `map_cam_tx, _ty, _tz` (metres) and `map_cam_qx, _qy, _qz, _qw`
(unit quaternion, w ≥ 0), the pose map_T_cam. [conventions.md](conventions.md) says what the frames are.

Where nothing gave a map metric scale (`scale_source` of align.ground_truth: none, or reference, unit unknown), what is
in m in its frame is in the map's own unit.

This page is written by `make docs`.
"""


def reference() -> str:
    """The whole page."""
    parts = [_HEAD]
    stage = ""
    for table in all_tables():
        if table.stage != stage:
            stage = table.stage
            parts.append(f"\n## {stage}\n")
        rows = [
            [f"`{name}`", kind, unit, column.frame, meaning] for column, name, kind, unit, meaning in _grouped(table)
        ]
        parts.append(f"\n### {table.name} ({table.version})\n\n{table.meaning}\n\n")
        parts.append(markdown_table("column | type | unit | frame | meaning", rows))
    return "".join(parts)


def column_lines(table: TableSchema) -> list[str]:
    """A table's columns as plain text, one line a column or pose group: `name: type [unit, frame]: meaning`."""
    lines = []
    for column, name, kind, unit, meaning in _grouped(table):
        where = ", ".join(filter(None, (unit, column.frame and f"frame {column.frame}")))
        lines.append(f"{name}: {kind}{f' [{where}]' if where else ''}: {meaning}")
    return lines


def _grouped(table: TableSchema) -> Iterator[tuple[Column, str, str, str, str]]:
    """Columns with the name, type, unit and meaning to show: a pose group is one row."""
    groups = {name.removesuffix("_qw") for name in table.column_names if name.endswith("_qw")}
    for column in table.columns:
        prefix, _, part = column.name.rpartition("_")
        kind = f"{column.dtype}{' or null' if column.nullable else ''}"
        if prefix not in groups or len(part) != 2:
            meaning = f"{column.meaning}: {', '.join(column.choices)}" if column.choices else column.meaning
            yield column, column.name, kind, column.unit, meaning
        elif part == "tx":
            yield column, f"{prefix}_*", kind, "m, unit quaternion", column.meaning.removesuffix(": position, x")
