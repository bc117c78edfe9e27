"""ios_logger: `ARposes.txt`, `Frames.txt` and `Frames.m4v`.

https://github.com/Varvrar/ios_logger (README, "Dataset format"). Times are seconds since 1970. Poses are ARKit's camera
to world with quaternions w first, maybe at twice the images' rate; a row of `Frames.txt` is a frame of the video.
`Accel.txt` is as Core Motion has it. `GPS.txt` has time, latitude, longitude and, of newer versions, horizontal
accuracy, altitude, vertical accuracy and more; it's read only where import is asked for GPS, `Head.txt` never.
"""

import math
from functools import partial
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import GpsFix, Intrinsics, Limits, RawFrame, Recording, Reject, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import check_join, frame_times
from groundwalk.store.choices import Clock


def read(path: Path, limits: Limits) -> Recording:
    poses, rejects = parsing.read_rows(parsing.lines_of(path / "ARposes.txt", limits), _read_pose)
    rows = parsing.lines_of(path / "Frames.txt", limits)
    video = path / "Frames.m4v"

    def read_image(index: int, line: str) -> RawFrame:
        time_s, _, fx, fy, cx, cy = parsing.split_numbers(line, 6, ",")
        image = VideoFrame(video, index)
        return RawFrame(parsing.seconds_to_ns(time_s), image=image, intrinsics=Intrinsics(fx, fy, cx, cy))

    images, more = parsing.read_rows(rows, read_image)
    notes = check_join(video, frame_times(video, limits), "Frames.txt", images, len(rows))
    frames = parsing.join_by_time(poses, images)
    gps = path / "GPS.txt"
    read_gps = partial(_read_gps, gps, limits) if gps.is_file() else None
    felt = parsing.core_motion(path / "Accel.txt", limits)
    rejects += more
    return Recording(
        "iOS, ios_logger", Clock.UNIX, path, frames, rejects, accelerations=felt, read_gps=read_gps, notes=notes
    )


def _read_pose(_: int, line: str) -> RawFrame:
    time_s, x, y, z, qw, qx, qy, qz = parsing.split_numbers(line, 8, ",")
    pose = parsing.from_arkit(parsing.quaternion_pose([x, y, z], [qx, qy, qz, qw]))
    return RawFrame(parsing.seconds_to_ns(time_s), pose)


def _read_gps(file: Path, limits: Limits) -> tuple[list[GpsFix], list[Reject]]:
    def read_fix(_: int, line: str) -> GpsFix:
        time_s, *values = parsing.split_numbers(line, separator=",")
        if len(values) < 2:
            raise parsing.BadRow(f"row has {1 + len(values)} numbers, not 3 or more")
        latitude, longitude, accuracy, altitude, altitude_sd = [*values[:5], *[math.nan] * (5 - len(values))]
        return GpsFix(parsing.seconds_to_ns(time_s), latitude, longitude, altitude, accuracy, altitude_sd)

    return parsing.read_fixes(parsing.lines_of(file, limits), read_fix)


FORMAT = Format(
    id="ios_logger",
    label="ios_logger",
    meaning="video, VIO",
    files=("ARposes.txt", "Frames.txt", "Frames.m4v"),
    read=read,
)
