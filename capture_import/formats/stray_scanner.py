"""Stray Scanner (Stray Robots): `rgb.mp4` with one row of `odometry.csv` a frame.

https://github.com/StrayRobots/scanner/blob/main/docs/format.md. Times are seconds since the phone was started; camera
axes are OpenCV's already, the world is ARKit's. Video and rows belong together by number, but the app gives the first
frame a time before the video's start, so an edit list hides it and a player shows one frame fewer than there are rows:
row n is then the video's frame n - 1. The older generation has one `camera_matrix.csv`, the last frame's, and depth as
`.npy`, which isn't read; the newer logs intrinsics a row. `imu.csv` has accelerations as Core Motion has them.
"""

import csv
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, Intrinsics, Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import check_join, frame_times
from groundwalk.store import UserError
from groundwalk.store.choices import Clock

_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_PER_FRAME = ("fx", "fy", "cx", "cy")


def read(path: Path, limits: Limits) -> Recording:
    video = path / "rgb.mp4"
    header, *rows = parsing.lines_of(path / "odometry.csv", limits) or [("odometry.csv", "")]
    names = [name.strip() for name in header[1].split(",")]
    if missing := [name for name in _COLUMNS if name not in names]:
        raise UserError(
            "odometry.csv lacks columns",
            where=path,
            expected=f"{', '.join(_COLUMNS)}, parted by commas",
            found=f"no {', '.join(missing)}; its first line: {header[1][:80] or 'empty'}",
        )
    shared = None if set(_PER_FRAME) <= set(names) else _camera_matrix(path / "camera_matrix.csv")
    video_ns = frame_times(video, limits)
    hidden = int(len(video_ns) < len(rows))

    def read_row(_: int, line: str) -> RawFrame:
        row = dict(zip(names, next(csv.reader([line], skipinitialspace=True)), strict=False))
        index = parsing.whole(row, "frame")
        xyz, xyzw = [parsing.number(row, a) for a in "xyz"], [parsing.number(row, f"q{a}") for a in "xyzw"]
        return RawFrame(
            parsing.seconds_to_ns(parsing.number(row, "timestamp"), "timestamp"),
            parsing.quaternion_pose(xyz, xyzw),
            None if 0 <= index < hidden else VideoFrame(video, index - hidden),
            shared or parsing.intrinsics(row, _PER_FRAME),
            depth=DepthFile.if_there(*(path / kind / f"{index:06d}.png" for kind in ("depth", "confidence"))),
            number=index,
        )

    frames, rejects = parsing.read_rows(rows, read_row)
    notes = ["one camera matrix, the last frame's, stands for all frames"] if shared else []
    if hidden:
        notes.append("the video doesn't show the first row's frame, as the app writes it: row n has the frame before n")
    notes += check_join(video, video_ns, "odometry.csv", frames, len(rows) - hidden)
    accelerations = parsing.core_motion(path / "imu.csv", limits)
    return Recording("iOS, Stray Scanner", Clock.BOOT, path, frames, rejects, accelerations=accelerations, notes=notes)


def _camera_matrix(file: Path) -> Intrinsics:
    with parsing.refused("the camera matrix can't be read", file, expected="3 rows of 3"):
        text = parsing.read_text(file).strip().replace("\n", ",")
        fx, _, cx, _, fy, cy, *_ = parsing.split_numbers(text, separator=",")
        return Intrinsics(fx, fy, cx, cy)


FORMAT = Format(
    id="stray_scanner", label="Stray Scanner", meaning="video, VIO, depth", files=("odometry.csv", "rgb.mp4"), read=read
)
