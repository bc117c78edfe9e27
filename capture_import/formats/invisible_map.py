"""Walks recorded for "invisible maps": one JSON file with ARKit poses, poses only.

Documented by its files, https://github.com/occamLab/invisible-map-generation: `pose_data` is a list of poses with
`timestamp` (seconds since the phone was started) and `pose`, 16 numbers column-major, ARKit's camera to world (y up,
z backward). `location_data` holds coordinates of the earth and is never read.
"""

from pathlib import Path
from typing import Any

from groundwalk.capture_import.capture import Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    json_of,
    number,
    numbers,
    refuse_unreadable,
    seconds_to_ns,
)
from groundwalk.store import UserError
from groundwalk.store.choices import Clock

_KEY = b'"pose_data"'
_LOOK_BYTES = 64 << 20


def detect(path: Path) -> bool:
    """A JSON file that has pose_data."""
    if path.suffix != ".json" or not path.is_file():
        return False
    with path.open("rb") as file:
        return _KEY in file.read(_LOOK_BYTES)


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the poses."""
    rows = json_of(path, limits).get("pose_data")
    if not isinstance(rows, list):
        raise UserError("pose_data is no list", where=path, expected="objects with timestamp and pose")
    frames, rejects = collect([(f"pose {i}", (i, row)) for i, row in enumerate(rows)], session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "timestamp and 16 numbers of pose")
    return RawSession(session_id, FORMAT.id, "iOS", Clock.BOOT, path.parent, frames, rejects)


def _read_row(source: str, row: tuple[int, Any]) -> RawFrame:
    index, content = row
    if not isinstance(content, dict):
        raise BadRow("pose is no object")
    pose = from_arkit(numbers(content, "pose", 16).reshape(4, 4).T)
    return RawFrame(index, source, seconds_to_ns(number(content, "timestamp"), "timestamp"), pose)


FORMAT = Format(
    id="invisible_map",
    label="Invisible Map walk",
    meaning="VIO only",
    looks_for="a JSON file with pose_data",
    detect=detect,
    read=read,
)
