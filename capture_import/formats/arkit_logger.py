"""ARKit Data Logger: `ARKit_camera_pose.txt`, poses only.

Documented at https://github.com/PyojinKim/ARKit-Data-Logger (README, "Output Format"): one row a pose, the time and a
3x4 matrix in row order, ARKit's camera to world (y up, z backward). Times are nanoseconds since the phone was started.
"""

from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    lines_of,
    refuse_unreadable,
    row_major_pose,
    seconds_to_ns,
    split_numbers,
)
from groundwalk.store.choices import Clock


def detect(path: Path) -> bool:
    """A file ARKit_camera_pose*.txt."""
    return path.is_file() and path.name.startswith("ARKit_camera_pose") and path.suffix == ".txt"


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the poses."""
    rows = [(source, (i, line)) for i, (source, line) in enumerate(lines_of(path, limits))]
    frames, rejects = collect(rows, session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "time and 12 numbers a row")
    return RawSession(session_id, FORMAT.id, "iOS, ARKit Data Logger", Clock.BOOT, path.parent, frames, rejects)


def _read_row(source: str, row: tuple[int, str]) -> RawFrame:
    index, line = row
    values = split_numbers(line)
    if len(values) != 13:
        raise BadRow(f"row has {len(values)} numbers, not 13")
    pose = from_arkit(row_major_pose(values[1:]))
    return RawFrame(index, source, seconds_to_ns(values[0] * 1e-9), pose)


FORMAT = Format(
    id="arkit_logger",
    label="ARKit Data Logger",
    meaning="VIO only",
    looks_for="ARKit_camera_pose*.txt",
    detect=detect,
    read=read,
)
