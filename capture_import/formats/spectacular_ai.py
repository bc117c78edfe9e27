"""Spectacular AI recordings: `output.jsonl` with poses, and `data.jsonl` with `data.mp4` where images were kept.

https://spectacularai.github.io/docs/sdk, and files of its examples. Poses take the device's axes to a world whose +z is
up; `imuToCamera` of `calibration.json` takes them to OpenCV camera axes. Without it poses are the device's, and images
aren't used. Rows of `data.jsonl` with `frames` are the video's, in order, which is `data.mov` on iOS. The app records
all but `output.jsonl`, which the SDK makes of it.
"""

import re
from pathlib import Path

import numpy as np

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import check_join, frame_times, is_video
from groundwalk.geometry.poses import Array, inverse, rigidity_error
from groundwalk.store.choices import Clock, Tracking

_STATES = {"TRACKING": Tracking.NORMAL, "INIT": Tracking.LIMITED, "LOST_TRACKING": Tracking.LOST}
_CAMERA = ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")


def detect(path: Path) -> bool:
    return (path / "output.jsonl").is_file()


def missing(path: Path) -> str:
    is_ours = re.search(rb'"(frames|sensor)"\s*:', parsing.first_bytes(path / "data.jsonl"))
    return "output.jsonl (its poses, which vio_jsonl of the SDK's examples writes)" if is_ours else ""


def read(path: Path, limits: Limits) -> Recording:
    calibration = path / "calibration.json"
    device_T_cam = _device_T_cam(calibration, limits) if calibration.is_file() else None

    def read_pose(_: int, line: str) -> RawFrame:
        row = parsing.parse_json(line)
        xyz = [parsing.number(row.get("position"), axis) for axis in "xyz"]
        xyzw = [parsing.number(row.get("orientation"), axis) for axis in "xyzw"]
        if not np.isfinite(xyz).all():
            raise parsing.BadRow("position has a value that isn't finite")
        pose = parsing.YUP_T_ZUP @ parsing.quaternion_pose(xyz, xyzw)
        return RawFrame(
            parsing.seconds_to_ns(parsing.number(row, "time")),
            pose if device_T_cam is None else pose @ device_T_cam,
            tracking=_STATES.get(str(row.get("status")), Tracking.UNKNOWN),
        )

    poses, rejects = parsing.read_rows(parsing.lines_of(path / "output.jsonl", limits), read_pose)
    notes: list[str] = []
    images: list[RawFrame] = []
    video = next(filter(is_video, parsing.in_order(path.glob("data.*"))), None)
    if device_T_cam is None:
        notes.append("no calibration.json: poses are the device's, and images aren't used")
    elif video is not None and (path / "data.jsonl").is_file():
        lines = parsing.lines_of(path / "data.jsonl", limits, lambda line: '"frames"' in line)
        images, more = parsing.read_rows(lines, lambda i, line: _read_image(video, i, line))
        notes += check_join(video, frame_times(video, limits), "data.jsonl", images, len(lines))
        rejects += more
    return Recording("Spectacular AI", Clock.BOOT, path, parsing.join_by_time(poses, images), rejects, notes=notes)


def _device_T_cam(calibration: Path, limits: Limits) -> Array:
    cameras = parsing.json_of(calibration, limits).get("cameras")
    with parsing.refused("the calibration can't be read", calibration):
        if not isinstance(cameras, list) or not cameras:
            raise parsing.BadRow("cameras is missing")
        cam_T_device = parsing.row_major_pose(parsing.numbers(cameras[0], "imuToCamera", 16))
        if not rigidity_error(cam_T_device) < 1e-2:
            raise parsing.BadRow("imuToCamera isn't rigid")
        return inverse(cam_T_device)


def _read_image(video: Path, index: int, line: str) -> RawFrame:
    content = parsing.parse_json(line)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not isinstance(frames[0], dict):
        raise parsing.BadRow("frames is empty")
    camera = parsing.intrinsics(frames[0].get("cameraParameters"), _CAMERA)
    t_ns = parsing.seconds_to_ns(parsing.number(content, "time"))
    return RawFrame(t_ns, image=VideoFrame(video, index), intrinsics=camera)


FORMAT = Format(
    id="spectacular_ai",
    label="Spectacular AI",
    meaning="video, VIO",
    files=("output.jsonl", "data.jsonl"),
    detect=detect,
    missing=missing,
    looks_for="output.jsonl, with data.jsonl, data.mp4 or data.mov, and calibration.json for images",
    read=read,
)
