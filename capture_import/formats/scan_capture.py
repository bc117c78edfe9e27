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

from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.joining import join_by_time
from groundwalk.capture_import.media.video import frame_times
from groundwalk.capture_import.parsing import (
    BadRow,
    from_arkit,
    lines_of,
    quaternion_pose,
    read_rows,
    seconds_to_ns,
    to_number,
    to_pixels,
)
from groundwalk.store.choices import Clock, Tracking


def read(path: Path, limits: Limits) -> Recording:
    """Read the rows and join them to the video's frames by time."""
    frames, rejects = read_rows(lines_of(path / "poses.txt", limits), _read_row)
    if not frames:
        return Recording("iOS, ScanCapture", Clock.BOOT, path, frames, rejects)
    video = path / "images.mp4"
    times = np.array([row.t_ns for row in frames], dtype=np.int64)
    video_ns = frame_times(video, limits)
    if not times.min() - 10**9 <= video_ns[0] <= times.max():  # it counts from the first image
        video_ns = video_ns - video_ns[0] + times[0]
    images = [
        RawFrame(
            number=i,
            source=f"{video.name} frame {i}",
            t_ns=int(t),
            vio_T_cam=None,
            image=VideoFrame(video, i),
            intrinsics=frames[int(np.argmin(np.abs(times - t)))].intrinsics,
        )
        for i, t in enumerate(video_ns)
    ]
    return Recording("iOS, ScanCapture", Clock.BOOT, path, join_by_time(frames, images), rejects)


def _read_row(number: int, source: str, line: str) -> RawFrame:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) not in (15, 16):
        raise BadRow(f"row has {len(fields)} fields, not 15 or 16")
    us, tx, ty, tz, qx, qy, qz, qw, width, height, fx, fy, cx, cy, *exposure = (
        to_number(field, "value") for i, field in enumerate(fields) if i != 1
    )
    return RawFrame(
        number=number,
        source=source,
        t_ns=seconds_to_ns(us * 1e-6),
        vio_T_cam=from_arkit(quaternion_pose([tx, ty, tz], [qx, qy, qz, qw])),
        intrinsics=Intrinsics(fx, fy, cx, cy, to_pixels(width), to_pixels(height)),
        tracking=_tracking(fields[1]),
        exposure_s=exposure[0] * 1e-6 if exposure else None,
    )


def _tracking(status: str) -> Tracking:
    lowered = status.lower()
    if lowered.startswith("normal"):
        return Tracking.NORMAL
    if lowered.startswith("limited"):
        return Tracking.LIMITED
    return Tracking.LOST if lowered.startswith("not") else Tracking.UNKNOWN


FORMAT = Format(
    id="scan_capture",
    label="ScanCapture (LaMAR)",
    meaning="video, VIO",
    files=("poses.txt", "images.mp4"),
    read=read,
)
