"""docs/reference/tables.md, made from the schemas so that it can't fall behind them."""

from groundwalk.store.schemas import Column, TableSchema, all_tables

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
        parts.append("| column | type | unit | frame | meaning |\n|---|---|---|---|---|\n")
        parts += [_row(column, name) for column, name in _grouped(table.columns)]
    return "".join(parts)


def column_lines(table: TableSchema) -> list[str]:
    """A table's columns as plain text, one line a column or pose group: `name: type [unit, frame]: meaning`."""
    lines = []
    for column, name in _grouped(table.columns):
        unit, meaning, null = _cells(column, name)
        where = ", ".join(filter(None, (unit, column.frame and f"frame {column.frame}")))
        lines.append(f"{name.strip('`')}: {column.dtype}{null}{f' [{where}]' if where else ''}: {meaning}")
    return lines


def _grouped(columns: list[Column]) -> list[tuple[Column, str]]:
    """Columns with the name to show: a pose group is one row."""
    prefixes = {c.name.removesuffix("_qw") for c in columns if c.name.endswith("_qw")}
    rows = []
    for column in columns:
        prefix, _, part = column.name.rpartition("_")
        if prefix not in prefixes or len(part) != 2:
            rows.append((column, f"`{column.name}`"))
        elif part == "tx":
            rows.append((column, f"`{prefix}_*`"))
    return rows


def _cells(column: Column, name: str) -> tuple[str, str, str]:
    """Unit, meaning, and what says that it may be null."""
    is_group = name.endswith("_*`")
    meaning = column.meaning.removesuffix(": position, x") if is_group else column.meaning
    if column.choices is not None:
        meaning += f": {', '.join(column.choices)}"
    return "m, unit quaternion" if is_group else column.unit, meaning, " or null" if column.nullable else ""


def _row(column: Column, name: str) -> str:
    unit, meaning, null = _cells(column, name)
    return f"| {name} | {column.dtype}{null} | {unit} | {column.frame} | {meaning} |\n"
