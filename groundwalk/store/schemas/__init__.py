"""What each table holds: columns with type, unit, frame and meaning, and a version a table.

One module a stage; each has ``TABLES``, a list of `TableSchema`, declared as text (`tables`). `schema(stage, table)`
finds one.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import import_module
from typing import Literal, cast

import pyarrow as pa

from groundwalk.consistency.decisions import Status
from groundwalk.store import choices
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
_STAGES = ("simulate", "import", "sfm", "align", "localise", "train", "fuse", "report")
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


def tables(stage: str, text: str) -> list[TableSchema]:
    """The tables that a text declares. A table begins with `<name> <version>: <meaning>`; its columns are indented by
    four, lines that go on by more:

        position_sd_m (float64?, m in map): type, ? where it may be null, unit and frame, either left out; meaning
        quality (QualityClass): text that is one of these choices
        gravity_{xyz} (float64): three columns; {} in the meaning stands for the letter
        map_cam (pose?): the seven columns of the pose group map_cam, of map_T_cam: tx ty tz (m), qx qy qz qw (unit)
        = frame_id t_ns    these columns, as the first table of the text that has them declares them
    """
    found: list[TableSchema] = []
    for entry in re.split(r"\n(?= {0,4}\S)", text.strip("\n")):
        head, _, meaning = " ".join(entry.split()).partition(": ")
        name, _, more = head.partition(" ")
        if not entry.startswith(" "):
            found.append(TableSchema(stage, name, meaning, [], more))
        elif name == "=":
            declared = {column.name: column for table in reversed(found) for column in table.columns}
            found[-1].columns.extend(declared[one] for one in more.split())
        else:
            found[-1].columns.extend(_columns(name, more.strip("()"), meaning))
    return found


def _columns(name: str, kind: str, meaning: str) -> Iterator[Column]:
    """The columns of one entry; `kind` is what stands in its parentheses."""
    dtype, _, where = kind.partition(", ")
    nullable, dtype = dtype.endswith("?"), dtype.removesuffix("?")
    if dtype == "pose":
        frame = name.split("_")[0]
        for axis in "xyz":
            yield Column(f"{name}_t{axis}", "float64", f"{meaning}: position, {axis}", "m", frame, nullable)
        for axis in "xyzw":
            yield Column(f"{name}_q{axis}", "float64", f"{meaning}: unit quaternion, {axis}", "", frame, nullable)
        return
    unit, _, frame = f" {where}".partition(" in ")
    of_text = None if dtype in _ARROW else Status if dtype == "Status" else getattr(choices, dtype)
    before, _, rest = name.partition("{")
    letters, _, after = rest.partition("}")
    for letter in letters or [""]:
        text = meaning.replace("{}", letter)
        as_stored = "string" if of_text else cast(DType, dtype)
        yield Column(f"{before}{letter}{after}", as_stored, text, unit.strip(), frame, nullable, of_text)


def stage_tables(stage: str) -> list[TableSchema]:
    """The schemas of one stage's tables."""
    module = "import_" if stage == "import" else stage  # a Python keyword
    found: list[TableSchema] = import_module(f"groundwalk.store.schemas.{module}").TABLES
    return found


def all_tables() -> list[TableSchema]:
    """Every schema, in the order of the pipeline."""
    return [table for stage in _STAGES for table in stage_tables(stage)]


def schema(stage: str, table: str) -> TableSchema:
    """The schema of one table; UserError where there is none."""
    for candidate in stage_tables(stage):
        if candidate.name == table:
            return candidate
    names = ", ".join(t.name for t in stage_tables(stage))
    raise UserError(f"no table {table!r} in stage {stage}", expected=f"one of {names}")
