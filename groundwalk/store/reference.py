"""docs/reference/tables.md, made from the schemas so that it can't fall behind them."""

from collections.abc import Iterator

from groundwalk.store.schemas import TableSchema, all_tables
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
        parts.append(f"\n### {table.name} ({table.version})\n\n{table.meaning}\n\n")
        parts.append(markdown_table("column | type | unit | frame | meaning", _rows(table)))
    return "".join(parts)


def _rows(table: TableSchema) -> Iterator[list[str]]:
    """A row a column; a pose group is one row."""
    groups = {name.removesuffix("_qw") for name in table.column_names if name.endswith("_qw")}
    for column in table.columns:
        prefix, _, part = column.name.rpartition("_")
        kind = f"{column.dtype}{' or null' if column.nullable else ''}"
        if prefix not in groups or len(part) != 2:
            meaning = f"{column.meaning}: {', '.join(column.choices)}" if column.choices else column.meaning
            yield [f"`{column.name}`", kind, column.unit, column.frame, meaning]
        elif part == "tx":
            meaning = column.meaning.removesuffix(": position, x")
            yield [f"`{prefix}_*`", kind, "m, unit quaternion", column.frame, meaning]
