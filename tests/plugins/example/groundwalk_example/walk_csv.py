"""`walk.csv`: a row a frame, with its image beside it.

- `t_s` in seconds since the phone was started; `fx`, `fy`, `cx`, `cy` in pixels;
- position in metres, quaternion xyzw, of camera axes x right, y down, z forward in a world whose +y is up: as ours.
"""

import csv
from pathlib import Path

from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.parsing import (
    inside,
    lines_of,
    number,
    quaternion_pose,
    read_rows,
    seconds_to_ns,
)
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, Tracking

COLUMNS = ["t_s", "image", "fx", "fy", "cx", "cy", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]


def read(path: Path, limits: Limits) -> Recording:
    """A row that can't be read becomes a reject."""
    header, *lines = lines_of(path / "walk.csv", limits) or [("", "")]
    if header[1].split(",") != COLUMNS:
        raise UserError("walk.csv has other columns", where=path, expected=",".join(COLUMNS), found=header[1])

    def read_row(index: int, source: str, line: str) -> RawFrame:
        row = dict(zip(COLUMNS, next(csv.reader([line])), strict=False))
        return RawFrame(
            number=index,
            source=source,
            t_ns=seconds_to_ns(number(row, "t_s")),
            vio_T_cam=quaternion_pose(
                [number(row, f"t{axis}") for axis in "xyz"], [number(row, f"q{axis}") for axis in "xyzw"]
            ),
            image=ImageFile(inside(path, row["image"])),
            intrinsics=Intrinsics.of(number(row, name) for name in ("fx", "fy", "cx", "cy")),
            tracking=Tracking.NORMAL,
        )

    frames, rejects = read_rows(lines, read_row)
    return Recording("unknown", Clock.BOOT, path, frames, rejects)


FORMAT = Format(
    id="walk_csv",
    label="walk.csv",
    meaning="images, VIO",
    files=("walk.csv",),
    read=read,
)
