"""ARCore Data Logger: `ARCore_sensor_pose.txt`, poses only.

Documented by the app's source and files, https://github.com/PyojinKim/ARCore-Data-Logger: one row a pose, the time in
nanoseconds, a quaternion xyzw and a position. It's ARCore's pose of Android's sensor axes (x right, y up, z out of the
screen, for the phone held in portrait) in a world whose +y is up; the axes are those of a camera that looks along -z.
Where the user taps a tag, some versions add a row with the time of the row before and the tags (`TAG001 TAG002`) at its
end. Its pose is the same or one of other axes, which nothing tells apart: such rows aren't read.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    lines_of,
    quaternion_pose,
    refuse_unreadable,
    seconds_to_ns,
    split_numbers,
)
from groundwalk.store.choices import Clock

_TAGS = re.compile(r"(\s+TAG\d+)+\s*$")


def detect(path: Path) -> bool:
    """A file ARCore_sensor_pose*.txt."""
    return path.is_file() and path.name.startswith("ARCore_sensor_pose") and path.suffix == ".txt"


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the poses."""
    lines = lines_of(path, limits)
    rows = list(_without_tags(lines))
    frames, rejects = collect(rows, session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "time, qx, qy, qz, qw, tx, ty, tz a row")
    notes = ["poses are of Android's sensor axes: turned from the camera's about the optical axis"]
    if tagged := len(lines) - len(rows):
        notes.append(f"{tagged} rows only add a tag to the pose before them: not read")
    device = "Android, ARCore Data Logger"
    return RawSession(session_id, FORMAT.id, device, Clock.BOOT, path.parent, frames, rejects, notes=notes)


def _without_tags(lines: Iterable[tuple[str, str]]) -> Iterator[tuple[str, tuple[int, str]]]:
    """(source, (place in the log, row)) of all rows but those that only add a tag to the row before them."""
    time = ""
    for index, (source, line) in enumerate(lines):
        if _TAGS.search(line) and line.split()[0] == time:
            continue
        time = line.split()[0]
        yield source, (index, line)


def _read_row(source: str, row: tuple[int, str]) -> RawFrame:
    index, line = row
    values = split_numbers(line)
    if len(values) != 8:
        raise BadRow(f"row has {len(values)} numbers, not 8")
    pose = from_arkit(quaternion_pose(values[5:], values[1:5]))
    return RawFrame(index, source, seconds_to_ns(values[0] * 1e-9), pose)


FORMAT = Format(
    id="arcore_logger",
    label="ARCore Data Logger",
    meaning="VIO only",
    looks_for="ARCore_sensor_pose*.txt",
    detect=detect,
    read=read,
)
