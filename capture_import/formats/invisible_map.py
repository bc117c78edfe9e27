"""Walks recorded for "invisible maps": one JSON file with ARKit poses, poses only.

Documented by its files, https://github.com/occamLab/invisible-map-generation: `pose_data` is a list of poses with
`timestamp` (seconds since the phone was started) and `pose`, 16 numbers column-major, ARKit's camera to world (y up,
z backward). `location_data` holds coordinates of the earth and is never read.
"""

from pathlib import Path
from typing import Any

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store import UserError
from groundwalk.store.choices import Clock


def detect(path: Path) -> bool:
    """A JSON file that has pose_data."""
    return path.suffix == ".json" and b'"pose_data"' in parsing.first_bytes(path, 64 << 20)


def read(path: Path, limits: Limits) -> Recording:
    """Read the poses."""
    rows = parsing.json_of(path, limits).get("pose_data")
    if not isinstance(rows, list):
        raise UserError("pose_data is no list", where=path, expected="objects with timestamp and pose")
    frames, rejects = parsing.read_rows([(f"pose {i}", row) for i, row in enumerate(rows)], _read_row)
    return Recording("iOS", Clock.BOOT, path.parent, frames, rejects)


def _read_row(_: int, row: Any) -> RawFrame:
    pose = parsing.from_arkit(parsing.numbers(row, "pose", 16).reshape(4, 4).T)
    return RawFrame(parsing.seconds_to_ns(parsing.number(row, "timestamp"), "timestamp"), pose)


FORMAT = Format(
    id="invisible_map",
    label="Invisible Map walk",
    meaning="VIO only",
    files=("*.json",),
    is_file=True,
    detect=detect,
    looks_for="a JSON file with pose_data",
    read=read,
)
