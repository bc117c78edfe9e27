"""ARCore Data Logger: `ARCore_sensor_pose.txt`, poses only.

Documented by the app's source and files, https://github.com/PyojinKim/ARCore-Data-Logger: one row a pose, the time in
nanoseconds, a quaternion xyzw and a position. It's ARCore's pose of Android's sensor axes (x right, y up, z out of the
screen, for the phone held in portrait) in a world whose +y is up; the axes are those of a camera that looks along -z.
"""

from pathlib import Path

from capture_import.capture import Limits, RawFrame, RawSession
from capture_import.formats import Format
from capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    lines_of,
    quaternion_pose,
    refuse_unreadable,
    seconds_to_ns,
    split_numbers,
)


def detect(path: Path) -> bool:
    """A file ARCore_sensor_pose*.txt."""
    return path.is_file() and path.name.startswith("ARCore_sensor_pose") and path.suffix == ".txt"


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the poses."""
    rows = [(source, (i, line)) for i, (source, line) in enumerate(lines_of(path, limits))]
    frames, rejects = collect(rows, session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "time, qx, qy, qz, qw, tx, ty, tz a row")
    notes = ["poses are of Android's sensor axes: turned from the camera's about the optical axis"]
    device = "Android, ARCore Data Logger"
    return RawSession(session_id, FORMAT.name, device, "boot", path.parent, frames, rejects, notes=notes)


def _read_row(source: str, row: tuple[int, str]) -> RawFrame:
    index, line = row
    values = split_numbers(line)
    if len(values) != 8:
        raise BadRow(f"row has {len(values)} numbers, not 8")
    pose = from_arkit(quaternion_pose(values[5:], values[1:5]))
    return RawFrame(index, source, seconds_to_ns(values[0] * 1e-9), pose)


FORMAT = Format(
    name="arcore_logger",
    title="ARCore Data Logger",
    gives="VIO only",
    looks_for="ARCore_sensor_pose*.txt",
    documentation="https://github.com/PyojinKim/ARCore-Data-Logger",
    detect=detect,
    read=read,
)
