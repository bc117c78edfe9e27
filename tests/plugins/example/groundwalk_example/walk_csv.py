"""`walk.csv`: a row a frame, with its image beside it.

- `t_s` in seconds since the phone was started; `fx`, `fy`, `cx`, `cy` in pixels;
- position in metres, quaternion xyzw, of camera axes x right, y down, z forward in a world whose +y is up: as ours.
"""

import csv
from pathlib import Path

from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.parsing import (
    collect,
    inside,
    lines_of,
    number,
    quaternion_pose,
    refuse_unreadable,
    seconds_to_ns,
)
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, Tracking

COLUMNS = ["t_s", "image", "fx", "fy", "cx", "cy", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]


def detect(path: Path) -> bool:
    """A folder with walk.csv."""
    return (path / "walk.csv").is_file()


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """A row that can't be read becomes a reject; a file without a readable row is a UserError."""
    header, *lines = lines_of(path / "walk.csv", limits) or [("", "")]
    if header[1].split(",") != COLUMNS:
        raise UserError("walk.csv has other columns", where=path, expected=",".join(COLUMNS), found=header[1])

    def read_row(source: str, line: tuple[int, str]) -> RawFrame:
        row = dict(zip(COLUMNS, next(csv.reader([line[1]])), strict=False))
        return RawFrame(
            number=line[0],
            source=source,
            t_ns=seconds_to_ns(number(row, "t_s")),
            vio_T_cam=quaternion_pose(
                [number(row, f"t{axis}") for axis in "xyz"], [number(row, f"q{axis}") for axis in "xyzw"]
            ),
            image=ImageFile(inside(path, row["image"])),
            intrinsics=Intrinsics.of(number(row, name) for name in ("fx", "fy", "cx", "cy")),
            tracking=Tracking.NORMAL,
        )

    rows = [(source, (index, text)) for index, (source, text) in enumerate(lines)]
    frames, rejects = collect(rows, session_id, read_row)
    refuse_unreadable(path, frames, rejects, ",".join(COLUMNS))
    return RawSession(session_id, FORMAT.id, "unknown", Clock.BOOT, path, frames, rejects)


FORMAT = Format(
    id="walk_csv",
    label="walk.csv",
    meaning="images, VIO",
    looks_for="walk.csv",
    detect=detect,
    read=read,
)
