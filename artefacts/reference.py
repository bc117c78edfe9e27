"""docs/artefacts.md, made from the schemas so that it can't fall behind them."""

from groundwalk.artefacts.schemas import Column, all_tables

_HEAD = """# Artefacts

What each stage leaves in `data/runs/<profile>/<scene>/<stage>/`: the tables below as Parquet, `recording.rrd` (a view
of them, with its blueprint) and `manifest.json` (inputs with hashes, resolved settings, versions, seed, git revision,
machine, seconds a step, figures). Parquet is the truth; each column carries its unit, frame and meaning as metadata.
A table's version is `major.minor`; a reader refuses another major.

A pose group is seven columns: `map_cam_*` stands for `map_cam_tx, _ty, _tz` (metres) and `map_cam_qx, _qy, _qz, _qw`
(unit quaternion, w ≥ 0), the pose map_T_cam. [conventions.md](conventions.md) says what the frames are.

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


def _grouped(columns: list[Column]) -> list[tuple[Column, str]]:
    """Columns with the name to show: a pose group is one row."""
    prefixes = {c.name.removesuffix("_qw") for c in columns if c.name.endswith("_qw")}
    shown = []
    for column in columns:
        prefix, _, part = column.name.rpartition("_")
        if prefix not in prefixes or len(part) != 2:
            shown.append((column, f"`{column.name}`"))
        elif part == "tx":
            shown.append((column, f"`{prefix}_*`"))
    return shown


def _row(column: Column, name: str) -> str:
    meaning = column.meaning.removesuffix(": position, x") if name.endswith("_*`") else column.meaning
    unit = "m, unit quaternion" if name.endswith("_*`") else column.unit
    null = " or null" if column.nullable else ""
    return f"| {name} | {column.dtype}{null} | {unit} | {column.frame} | {meaning} |\n"
