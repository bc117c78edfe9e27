"""ScanCapture, LaMAR's recorder: `poses.txt` with `images.mp4`.

https://github.com/microsoft/lamar-benchmark/tree/main/apps/ScanCapture_iOS (README, "Data format"). Times are whole
microseconds since the phone was started; poses are ARKit's camera to world. A row is written for every ARKit frame, an
image at the chosen rate: they're joined by time. Video times are those of the rows, or count from the first image,
which is the first row's. `location.txt` and `bluetooth.txt` are never read.
"""

from pathlib import Path

import numpy as np

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import frame_times
from groundwalk.store.choices import Clock, Tracking

_TRACKING = {"normal": Tracking.NORMAL, "limited": Tracking.LIMITED, "not": Tracking.LOST}


def read(path: Path, limits: Limits) -> Recording:
    frames, rejects = parsing.read_rows(parsing.lines_of(path / "poses.txt", limits), _read_row)
    if frames:
        video = path / "images.mp4"
        times = np.array([row.t_ns for row in frames], dtype=np.int64)
        video_ns = frame_times(video, limits)
        if not times.min() - 10**9 <= video_ns[0] <= times.max():  # it counts from the first image
            video_ns = video_ns - video_ns[0] + times[0]
        rows = [frames[int(np.argmin(np.abs(times - t)))] for t in video_ns]
        images = [
            RawFrame(
                int(t),
                image=VideoFrame(video, i),
                intrinsics=row.intrinsics,
                exposure_s=row.exposure_s,
                source=f"{video.name} frame {i}",
            )
            for i, (t, row) in enumerate(zip(video_ns, rows, strict=True))
        ]
        frames = parsing.join_by_time(frames, images)
    accelerations = parsing.core_motion(path / "accelerometer.txt", limits, unit_s=1e-6)
    return Recording("iOS, ScanCapture", Clock.BOOT, path, frames, rejects, accelerations=accelerations)


def _read_row(_: int, line: str) -> RawFrame:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) not in (15, 16):
        raise parsing.BadRow(f"row has {len(fields)} fields, not 15 or 16")
    status = fields.pop(1).lower()
    numbers = (parsing.to_number(field, "value") for field in fields)
    us, tx, ty, tz, qx, qy, qz, qw, width, height, fx, fy, cx, cy, *exposure = numbers
    return RawFrame(
        parsing.seconds_to_ns(us * 1e-6),
        parsing.from_arkit(parsing.quaternion_pose([tx, ty, tz], [qx, qy, qz, qw])),
        intrinsics=Intrinsics(fx, fy, cx, cy, parsing.to_pixels(width), parsing.to_pixels(height)),
        tracking=next((state for name, state in _TRACKING.items() if status.startswith(name)), Tracking.UNKNOWN),
        exposure_s=exposure[0] * 1e-6 if exposure else None,
    )


FORMAT = Format(
    id="scan_capture", label="ScanCapture (LaMAR)", meaning="video, VIO", files=("poses.txt", "images.mp4"), read=read
)
