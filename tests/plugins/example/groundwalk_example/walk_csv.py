"""`walk.csv`: a row a frame, with its image beside it.

- `t_s` in seconds since the phone was started; `fx`, `fy`, `cx`, `cy` in pixels;
- position in metres, quaternion xyzw, of camera axes x right, y down, z forward in a world whose +y is up: as ours.
"""

import csv
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, Tracking

COLUMNS = ["t_s", "image", "fx", "fy", "cx", "cy", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]


def read(path: Path, limits: Limits) -> Recording:
    """A row that can't be read becomes a reject."""
    header, *lines = parsing.lines_of(path / "walk.csv", limits) or [("", "")]
    if header[1].split(",") != COLUMNS:
        raise UserError("walk.csv has other columns", where=path, expected=",".join(COLUMNS), found=header[1])

    def read_row(_: int, line: str) -> RawFrame:
        row = dict(zip(COLUMNS, next(csv.reader([line])), strict=False))
        position, xyzw = ([parsing.number(row, key) for key in keys] for keys in (COLUMNS[6:9], COLUMNS[9:]))
        return RawFrame(
            t_ns=parsing.seconds_to_ns(parsing.number(row, "t_s")),
            vio_T_cam=parsing.quaternion_pose(position, xyzw),
            image=ImageFile(parsing.inside(path, row["image"])),
            intrinsics=parsing.intrinsics(row),
            tracking=Tracking.NORMAL,
        )

    frames, rejects = parsing.read_rows(lines, read_row)
    return Recording("unknown", Clock.BOOT, path, frames, rejects)


FORMAT = Format(
    id="walk_csv",
    label="walk.csv",
    meaning="images, VIO",
    files=("walk.csv",),
    read=read,
)
