"""What each table holds: columns with type, unit, frame and meaning, and a version a table.

One module a stage; each has ``TABLES``, a list of `TableSchema`. `schema(stage, table)` finds one.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from typing import Literal

import pyarrow as pa

from groundwalk.store.errors import UserError

DType = Literal["float64", "int64", "bool", "string", "list<float64>", "list<string>"]

_ARROW = {
    "float64": pa.float64(),
    "int64": pa.int64(),
    "bool": pa.bool_(),
    "string": pa.string(),
    "list<float64>": pa.list_(pa.float64()),
    "list<string>": pa.list_(pa.string()),
}

# Stage name -> schema module; `import` is a Python keyword, hence the underscore.
_MODULES = {
    "simulate": "simulate",
    "import": "import_",
    "sfm": "sfm",
    "align": "align",
    "localise": "localise",
    "train": "train",
    "fuse": "fuse",
    "report": "report",
}

_PATHS = {"image", "depth", "depth_confidence", "folder", "file", "model", "scene"}


@dataclass(frozen=True)
class Column:
    """One column: its type, unit ("m", "deg", "ns", "px", ...), the frame it is given in, and what it means; `choices`
    are those that its text can have."""

    name: str
    dtype: DType
    meaning: str
    unit: str = ""
    frame: str = ""
    nullable: bool = False
    choices: type[StrEnum] | None = None

    @property
    def is_path(self) -> bool:
        """Whether its text is a path relative to a folder, or becomes part of one."""
        return self.name.endswith("_id") or self.name in _PATHS

    def arrow(self) -> pa.Field:
        metadata = {"unit": self.unit, "frame": self.frame, "meaning": self.meaning}
        return pa.field(self.name, _ARROW[self.dtype], self.nullable, {k: v for k, v in metadata.items() if v})


def pose_columns(prefix: str, meaning: str, nullable: bool = False) -> list[Column]:
    """The seven columns of a pose group, e.g. prefix ``map_cam`` for map_T_cam: tx ty tz (m), qx qy qz qw (unit)."""
    frame = prefix.split("_")[0]
    axes = [Column(f"{prefix}_t{a}", "float64", f"{meaning}: position, {a}", "m", frame, nullable) for a in "xyz"]
    return axes + [
        Column(f"{prefix}_q{a}", "float64", f"{meaning}: unit quaternion, {a}", "", frame, nullable) for a in "xyzw"
    ]


@dataclass(frozen=True)
class TableSchema:
    """A table: its stage, name, version ("major.minor"; a reader refuses another major), meaning and columns."""

    stage: str
    name: str
    meaning: str
    columns: list[Column] = field(repr=False)
    version: str = "1.0"

    @property
    def column_names(self) -> list[str]:
        return [column.name for column in self.columns]

    def arrow(self) -> pa.Schema:
        metadata = {
            "groundwalk.table": f"{self.stage}.{self.name}",
            "groundwalk.version": self.version,
            "groundwalk.meaning": self.meaning,
        }
        return pa.schema([column.arrow() for column in self.columns], metadata)


def stage_tables(stage: str) -> list[TableSchema]:
    """The schemas of one stage's tables."""
    tables: list[TableSchema] = import_module(f"groundwalk.store.schemas.{_MODULES[stage]}").TABLES
    return tables


def all_tables() -> Iterable[TableSchema]:
    """Every schema, in the order of the pipeline."""
    for stage in _MODULES:
        yield from stage_tables(stage)


def schema(stage: str, table: str) -> TableSchema:
    """The schema of one table; UserError where there is none."""
    for candidate in stage_tables(stage):
        if candidate.name == table:
            return candidate
    names = ", ".join(t.name for t in stage_tables(stage))
    raise UserError(f"no table {table!r} in stage {stage}", expected=f"one of {names}")
