"""ARCore Data Logger: `ARCore_sensor_pose.txt`, poses only.

Documented by the app's source and files, https://github.com/PyojinKim/ARCore-Data-Logger: one row a pose, the time in
nanoseconds, a quaternion xyzw and a position. It's ARCore's pose of Android's sensor axes (x right, y up, z out of the
screen, for the phone held in portrait) in a world whose +y is up; the axes are those of a camera that looks along -z.
Where the user taps a tag, some versions add a row with the time of the row before and the tags (`TAG001 TAG002`) at its
end. Its pose is the same or one of other axes, which nothing tells apart: such rows aren't read.
"""

import re
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock

_TAGS = re.compile(r"(\s+TAG\d+)+\s*$")


def read(path: Path, limits: Limits) -> Recording:
    """Read the poses, without rows that only add a tag to the one before them."""
    lines = parsing.lines_of(path, limits)
    times = [line.split()[0] for _, line in lines]
    rows = [
        (source, line)
        for (source, line), time, before in zip(lines, times, ["", *times], strict=False)
        if time != before or not _TAGS.search(line)
    ]
    frames, rejects = parsing.read_rows(rows, _read_row)
    notes = ["poses are of Android's sensor axes: turned from the camera's about the optical axis"]
    if tagged := len(lines) - len(rows):
        notes.append(f"{tagged} rows only add a tag to the pose before them: not read")
    return Recording("Android, ARCore Data Logger", Clock.BOOT, path.parent, frames, rejects, notes=notes)


def _read_row(_: int, line: str) -> RawFrame:
    time_ns, qx, qy, qz, qw, *position = parsing.split_numbers(line, 8)
    pose = parsing.from_arkit(parsing.quaternion_pose(position, [qx, qy, qz, qw]))
    return RawFrame(parsing.seconds_to_ns(time_ns * 1e-9), pose)


FORMAT = Format(
    id="arcore_logger",
    label="ARCore Data Logger",
    meaning="VIO only",
    files=("ARCore_sensor_pose*.txt",),
    is_file=True,
    read=read,
)
