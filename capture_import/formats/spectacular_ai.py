"""Spectacular AI recordings: `output.jsonl` with poses, and `data.jsonl` with `data.mp4` where images were kept.

Documented at https://spectacularai.github.io/docs/sdk and by files of the SDK's examples. What matters:

- JSON objects a line; `time` in seconds;
- `output.jsonl`: `position` and `orientation` (x, y, z, w) take the device's axes to a world whose +z is up;
  `status` is the odometry's state;
- `data.jsonl`: rows with `frames` say when the video's frames were taken and with which camera parameters, in order;
- `calibration.json`: `imuToCamera` takes device axes to OpenCV camera axes. Without it a pose can't be the camera's:
  the poses are then of the device, and images aren't used.
"""

from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.capture_import.capture import Intrinsics, Limits, RawFrame, RawSession, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.joining import join_by_time
from groundwalk.capture_import.media.video import require_row_per_frame
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    json_of,
    lines_of,
    number,
    numbers,
    parse_json,
    quaternion_pose,
    refuse_unreadable,
    row_major_pose,
    seconds_to_ns,
)
from groundwalk.geometry.poses import Array, inverse, rigidity_error
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, Tracking

# A world with +z up, seen with +y up.
_YUP_T_ZUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_STATES = {
    "TRACKING": Tracking.NORMAL,
    "INIT": Tracking.LIMITED,
    "LOST_TRACKING": Tracking.LOST,
}


def detect(path: Path) -> bool:
    """A folder with output.jsonl."""
    return (path / "output.jsonl").is_file()


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the poses, and the video's frames where they can be used."""
    calibration = path / "calibration.json"
    device_T_cam = _device_T_cam(json_of(calibration, limits), calibration) if calibration.is_file() else None

    def read_pose(source: str, line: str) -> RawFrame:
        row = parse_json(line)
        position, orientation = (row.get(key) for key in ("position", "orientation"))
        if not isinstance(position, dict) or not isinstance(orientation, dict):
            raise BadRow("position or orientation is no object")
        xyz, xyzw = [number(position, a) for a in "xyz"], [number(orientation, a) for a in "xyzw"]
        if not np.isfinite(xyz).all():
            raise BadRow("position has a value that isn't finite")
        pose = _YUP_T_ZUP @ quaternion_pose(xyz, xyzw)
        return RawFrame(
            number=0,
            source=source,
            t_ns=seconds_to_ns(number(row, "time")),
            vio_T_cam=pose if device_T_cam is None else pose @ device_T_cam,
            tracking=_STATES.get(str(row.get("status")), Tracking.UNKNOWN),
        )

    poses, rejects = collect(lines_of(path / "output.jsonl", limits), session_id, read_pose)
    refuse_unreadable(path, poses, rejects, "time, position and orientation a row")
    notes: list[str] = []
    images: list[RawFrame] = []
    video = path / "data.mp4"
    if device_T_cam is None:
        notes.append("no calibration.json: poses are the device's, and images aren't used")
    elif video.is_file() and (path / "data.jsonl").is_file():
        images, more = _read_images(path, session_id, limits)
        rejects += more
    return RawSession(
        session_id,
        FORMAT.id,
        "Spectacular AI",
        Clock.BOOT,
        path,
        join_by_time(poses, images),
        rejects,
        notes=notes,
    )


def _device_T_cam(calibration: dict[str, Any], path: Path) -> Array:
    cameras = calibration.get("cameras")
    try:
        if not isinstance(cameras, list) or not cameras or not isinstance(cameras[0], dict):
            raise BadRow("cameras is missing")
        cam_T_device = row_major_pose(numbers(cameras[0], "imuToCamera", 16))
        if not rigidity_error(cam_T_device) < 1e-2:
            raise BadRow("imuToCamera isn't rigid")
        return inverse(cam_T_device)
    except BadRow as error:
        raise UserError("the calibration can't be read", where=path, found=error) from None


def _read_images(path: Path, session_id: str, limits: Limits) -> tuple[list[RawFrame], list[Any]]:
    lines = lines_of(path / "data.jsonl", limits, lambda line: '"frames"' in line)
    video = path / "data.mp4"
    require_row_per_frame(video, "data.jsonl", len(lines), limits)

    def read_image(source: str, row: tuple[int, str]) -> RawFrame:
        index, line = row
        content = parse_json(line)
        frames = content.get("frames")
        if not isinstance(frames, list) or not frames or not isinstance(frames[0], dict):
            raise BadRow("frames is empty")
        camera = frames[0].get("cameraParameters")
        if not isinstance(camera, dict):
            raise BadRow("cameraParameters is missing")
        keys = ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
        return RawFrame(
            number=index,
            source=source,
            t_ns=seconds_to_ns(number(content, "time")),
            vio_T_cam=None,
            image=VideoFrame(video, index),
            intrinsics=Intrinsics.of(number(camera, key) for key in keys),
        )

    return collect([(s, (i, line)) for i, (s, line) in enumerate(lines)], session_id, read_image)


FORMAT = Format(
    id="spectacular_ai",
    label="Spectacular AI",
    meaning="video, VIO",
    looks_for="output.jsonl, with data.jsonl, data.mp4 and calibration.json for images",
    detect=detect,
    read=read,
)
