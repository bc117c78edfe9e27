"""ios_logger: `ARposes.txt`, `Frames.txt` and `Frames.m4v`.

Documented at https://github.com/Varvrar/ios_logger (README, "Dataset format"). What matters:

- times are seconds since 1970, on one clock in both text files;
- `ARposes.txt`: time, x, y, z, qw, qx, qy, qz (w first), ARKit's camera to world, at ARKit's rate, which may be twice
  that of the images;
- `Frames.txt`: time, frame number, fx, fy, cx, cy, a row for each frame of `Frames.m4v` in their order.

`GPS.txt` and `Head.txt` are never read.
"""

from pathlib import Path

from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, RawSession, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.joining import join_by_time
from groundwalk.capture_import.media.video import require_row_per_frame
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


def detect(path: Path) -> bool:
    """A folder with ARposes.txt, Frames.txt and Frames.m4v."""
    return all((path / name).is_file() for name in ("ARposes.txt", "Frames.txt", "Frames.m4v"))


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read poses and images and join them by time; images and video frames belong together by number."""
    poses, rejects = collect(lines_of(path / "ARposes.txt", limits), session_id, _read_pose)
    refuse_unreadable(path, poses, rejects, "time, x, y, z, qw, qx, qy, qz")
    rows = lines_of(path / "Frames.txt", limits)
    video = path / "Frames.m4v"
    require_row_per_frame(video, "Frames.txt", len(rows), limits)

    def read_image(source: str, row: tuple[int, str]) -> RawFrame:
        index, line = row
        values = split_numbers(line, ",")
        if len(values) != 6:
            raise BadRow(f"row has {len(values)} numbers, not 6")
        return RawFrame(
            number=index,
            source=source,
            t_ns=seconds_to_ns(values[0]),
            vio_T_cam=None,
            image=VideoFrame(video, index),
            intrinsics=Intrinsics.of(values[2:]),
        )

    indexed = [(source, (i, line)) for i, (source, line) in enumerate(rows)]
    images, more = collect(indexed, session_id, read_image)
    return RawSession(
        session_id, FORMAT.id, "iOS, ios_logger", Clock.UNIX, path, join_by_time(poses, images), [*rejects, *more]
    )


def _read_pose(source: str, line: str) -> RawFrame:
    values = split_numbers(line, ",")
    if len(values) != 8:
        raise BadRow(f"row has {len(values)} numbers, not 8")
    t, x, y, z, qw, qx, qy, qz = values
    pose = from_arkit(quaternion_pose([x, y, z], [qx, qy, qz, qw]))
    return RawFrame(number=0, source=source, t_ns=seconds_to_ns(t), vio_T_cam=pose)


FORMAT = Format(
    id="ios_logger",
    label="ios_logger",
    meaning="video, VIO",
    looks_for="ARposes.txt, Frames.txt and Frames.m4v",
    detect=detect,
    read=read,
)
