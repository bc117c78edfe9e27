"""ScanCapture, LaMAR's recorder: `poses.txt` with `images.mp4`.

Documented at https://github.com/microsoft/lamar-benchmark/tree/main/apps/ScanCapture_iOS (README, "Data format").
What matters:

- all times are whole microseconds since the phone was started;
- `poses.txt`, comma-separated: timestamp, status, tx, ty, tz, qx, qy, qz, qw, w, h, fx, fy, cx, cy and, in newer
  versions, exposure in microseconds; ARKit's camera to world (y up, z backward);
- a row is written for every ARKit frame, an image at the chosen rate: they're joined by time. Video times are those of
  the rows, or count from the first image where the container stores them so; the first row is the first image's then.

`location.txt` and `bluetooth.txt` are never read.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, RawSession, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.joining import join_by_time
from groundwalk.capture_import.media.video import frame_times
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    lines_of,
    quaternion_pose,
    refuse_unreadable,
    seconds_to_ns,
    to_number,
)
from groundwalk.store.choices import Clock, Tracking


def detect(path: Path) -> bool:
    """A folder with poses.txt and images.mp4."""
    return (path / "poses.txt").is_file() and (path / "images.mp4").is_file()


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the rows and join them to the video's frames by time."""
    frames, rejects = collect(lines_of(path / "poses.txt", limits), session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "timestamp, status, tx .. tz, qx .. qw, w, h, fx, fy, cx, cy")
    video = path / "images.mp4"
    times = np.array([row.t_ns for row in frames], dtype=np.int64)
    images = [
        RawFrame(
            number=i,
            source=f"{video.name} frame {i}",
            t_ns=int(t),
            vio_T_cam=None,
            image=VideoFrame(video, i),
            intrinsics=frames[int(np.argmin(np.abs(times - t)))].intrinsics,
        )
        for i, t in enumerate(_on_clock(frame_times(video, limits), times))
    ]
    return RawSession(
        session_id, FORMAT.id, "iOS, ScanCapture", Clock.BOOT, path, join_by_time(frames, images), rejects
    )


def _read_row(source: str, line: str) -> RawFrame:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) not in (15, 16):
        raise BadRow(f"row has {len(fields)} fields, not 15 or 16")
    us, tx, ty, tz, qx, qy, qz, qw, width, height, fx, fy, cx, cy, *exposure = (
        to_number(field, "value") for i, field in enumerate(fields) if i != 1
    )
    return RawFrame(
        number=0,
        source=source,
        t_ns=seconds_to_ns(us * 1e-6),
        vio_T_cam=from_arkit(quaternion_pose([tx, ty, tz], [qx, qy, qz, qw])),
        intrinsics=Intrinsics(fx, fy, cx, cy, _pixels(width), _pixels(height)),
        tracking=_tracking(fields[1]),
        exposure_s=exposure[0] * 1e-6 if exposure else None,
    )


def _pixels(value: float) -> int:
    if not 0 < value < 1e6:
        raise BadRow(f"image size {value} is none")
    return int(value)


def _tracking(status: str) -> Tracking:
    lowered = status.lower()
    if lowered.startswith("normal"):
        return Tracking.NORMAL
    if lowered.startswith("limited"):
        return Tracking.LIMITED
    return Tracking.LOST if lowered.startswith("not") else Tracking.UNKNOWN


def _on_clock(video_ns: NDArray[np.int64], pose_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Video times on the poses' clock."""
    absolute = pose_ns.min() - 10**9 <= video_ns[0] <= pose_ns.max()
    return video_ns if absolute else video_ns - video_ns[0] + pose_ns[0]


FORMAT = Format(
    id="scan_capture",
    label="ScanCapture (LaMAR)",
    meaning="video, VIO",
    looks_for="poses.txt and images.mp4",
    detect=detect,
    read=read,
)
