"""ARKit Data Logger: `ARKit_camera_pose.txt`, poses only.

Documented at https://github.com/PyojinKim/ARKit-Data-Logger (README, "Output Format"): one row a pose, the time and a
3x4 matrix in row order, ARKit's camera to world (y up, z backward). Times are nanoseconds since the phone was started.
"""

from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock


def read(path: Path, limits: Limits) -> Recording:
    """Read the poses."""
    frames, rejects = parsing.read_rows(parsing.lines_of(path, limits), _read_row)
    return Recording("iOS, ARKit Data Logger", Clock.BOOT, path.parent, frames, rejects)


def _read_row(_: int, line: str) -> RawFrame:
    time_ns, *matrix = parsing.split_numbers(line, 13)
    pose = parsing.from_arkit(parsing.row_major_pose(matrix))
    return RawFrame(parsing.seconds_to_ns(time_ns * 1e-9), pose)


FORMAT = Format(
    id="arkit_logger",
    label="ARKit Data Logger",
    meaning="VIO only",
    files=("ARKit_camera_pose*.txt",),
    is_file=True,
    read=read,
)
