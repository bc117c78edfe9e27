"""ios_logger: `ARposes.txt`, `Frames.txt` and `Frames.m4v`.

Documented at https://github.com/Varvrar/ios_logger (README, "Dataset format"). What matters:

- times are seconds since 1970, on one clock in both text files;
- `ARposes.txt`: time, x, y, z, qw, qx, qy, qz (w first), ARKit's camera to world, at ARKit's rate, which may be twice
  that of the images;
- `Frames.txt`: time, frame number, fx, fy, cx, cy, a row for each frame of `Frames.m4v` in their order.

`GPS.txt` and `Head.txt` are never read.
"""

from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import require_row_per_frame
from groundwalk.store.choices import Clock


def read(path: Path, limits: Limits) -> Recording:
    """Read poses and images and join them by time; images and video frames belong together by number."""
    poses, rejects = parsing.read_rows(parsing.lines_of(path / "ARposes.txt", limits), _read_pose)
    rows = parsing.lines_of(path / "Frames.txt", limits)
    video = path / "Frames.m4v"
    require_row_per_frame(video, "Frames.txt", len(rows), limits)

    def read_image(index: int, line: str) -> RawFrame:
        time_s, _, *camera = parsing.split_numbers(line, 6, ",")
        image = VideoFrame(video, index)
        return RawFrame(parsing.seconds_to_ns(time_s), image=image, intrinsics=Intrinsics.of(camera))

    images, more = parsing.read_rows(rows, read_image)
    frames = parsing.join_by_time(poses, images)
    return Recording("iOS, ios_logger", Clock.UNIX, path, frames, [*rejects, *more])


def _read_pose(_: int, line: str) -> RawFrame:
    time_s, x, y, z, qw, qx, qy, qz = parsing.split_numbers(line, 8, ",")
    pose = parsing.from_arkit(parsing.quaternion_pose([x, y, z], [qx, qy, qz, qw]))
    return RawFrame(parsing.seconds_to_ns(time_s), pose)


FORMAT = Format(
    id="ios_logger",
    label="ios_logger",
    meaning="video, VIO",
    files=("ARposes.txt", "Frames.txt", "Frames.m4v"),
    read=read,
)
