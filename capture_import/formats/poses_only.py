"""Logs of poses without images: of use to study odometry.

ARKit Data Logger (https://github.com/PyojinKim/ARKit-Data-Logger, README, "Output Format"): time in nanoseconds since
the phone was started, and ARKit's camera to world, 3x4.

ARCore Data Logger (https://github.com/PyojinKim/ARCore-Data-Logger, its source and files): time in nanoseconds, a
quaternion xyzw and a position, ARCore's pose of Android's sensor axes (x right, y up, z out of the screen, for the
phone held in portrait) in a world whose +y is up. Where the user taps a tag, some versions add a row with the time of
the row before and the tags at its end, whose pose is the same or one of other axes: such rows aren't read.

"Invisible maps" (https://github.com/occamLab/invisible-map-generation): `pose_data` of one JSON file has `timestamp`,
seconds since the phone was started, and `pose`, column-major, ARKit's camera to world; `location_data` is never read.
"""

import re
from functools import partial
from pathlib import Path
from typing import Any

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store import UserError
from groundwalk.store.choices import Clock

_TAGS = re.compile(r"(\s+TAG\d+)+\s*$")


def read_arkit(path: Path, limits: Limits) -> Recording:
    def read_row(_: int, line: str) -> RawFrame:
        time_ns, *matrix = parsing.split_numbers(line, 13)
        pose = parsing.from_arkit(parsing.row_major_pose(matrix))
        return RawFrame(parsing.seconds_to_ns(time_ns * 1e-9), pose)

    frames, rejects = parsing.read_rows(parsing.lines_of(path, limits), read_row)
    return Recording("iOS, ARKit Data Logger", Clock.BOOT, path.parent, frames, rejects)


def read_arcore(path: Path, limits: Limits) -> Recording:
    lines = parsing.lines_of(path, limits)
    times = [line.split()[0] for _, line in lines]
    rows = [
        (source, line)
        for (source, line), time, before in zip(lines, times, ["", *times], strict=False)
        if time != before or not _TAGS.search(line)
    ]

    def read_row(_: int, line: str) -> RawFrame:
        time_ns, qx, qy, qz, qw, *position = parsing.split_numbers(line, 8)
        pose = parsing.from_arkit(parsing.quaternion_pose(position, [qx, qy, qz, qw]))
        return RawFrame(parsing.seconds_to_ns(time_ns * 1e-9), pose)

    frames, rejects = parsing.read_rows(rows, read_row)
    notes = ["poses are of Android's sensor axes: turned from the camera's about the optical axis"]
    if tagged := len(lines) - len(rows):
        notes.append(f"{tagged} rows only add a tag to the pose before them: not read")
    return Recording("Android, ARCore Data Logger", Clock.BOOT, path.parent, frames, rejects, notes=notes)


def is_invisible_map(path: Path) -> bool:
    return path.suffix == ".json" and b'"pose_data"' in parsing.first_bytes(path, 64 << 20)


def read_invisible_map(path: Path, limits: Limits) -> Recording:
    rows = parsing.json_of(path, limits).get("pose_data")
    if not isinstance(rows, list):
        raise UserError("pose_data is no list", where=path, expected="objects with timestamp and pose")

    def read_row(_: int, row: Any) -> RawFrame:
        pose = parsing.from_arkit(parsing.numbers(row, "pose", 16).reshape(4, 4).T)
        return RawFrame(parsing.seconds_to_ns(parsing.number(row, "timestamp"), "timestamp"), pose)

    frames, rejects = parsing.read_rows([(f"pose {i}", row) for i, row in enumerate(rows)], read_row)
    return Recording("iOS", Clock.BOOT, path.parent, frames, rejects)


_of_one_file = partial(Format, meaning="VIO only", is_file=True)
ARKIT_LOGGER = _of_one_file(
    id="arkit_logger", label="ARKit Data Logger", files=("ARKit_camera_pose*.txt",), read=read_arkit
)
ARCORE_LOGGER = _of_one_file(
    id="arcore_logger", label="ARCore Data Logger", files=("ARCore_sensor_pose*.txt",), read=read_arcore
)
INVISIBLE_MAP = _of_one_file(
    id="invisible_map",
    label="Invisible Map walk",
    files=("*.json",),
    detect=is_invisible_map,
    looks_for="a JSON file with pose_data",
    read=read_invisible_map,
)
