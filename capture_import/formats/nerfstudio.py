"""nerfstudio: `transforms.json` over images, with poses from SfM.

Documented at https://docs.nerf.studio/quickstart/data_conventions.html. What matters:

- `transform_matrix` is camera to world with OpenGL's camera axes (y up, z backward), which are ARKit's;
- `applied_transform` (3x4), where there is one, took the poses from an earlier world to the file's; it's undone, so
  that an export of ours comes back with +y up;
- intrinsics are at the top or, going before these, each frame's own: fl_x, fl_y, cx, cy, w, h, and OpenCV's k1, k2, k3,
  p1, p2; `camera_model` is OPENCV, PINHOLE or OPENCV_FISHEYE with k1 to k4 (others are refused);
- nothing says what the unit is, or where up: scale and vertical are known for our own exports alone;
- `test_filenames`, where there are any, say which recordings are for testing;
- frames have no times, and the order of names isn't one of time.

The poses are a reference, not VIO. Each folder of images in `images/` is a recording.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.artefacts import UserError
from groundwalk.artefacts.choices import Clock, PoseSource
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, RawSession, Reject
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_folders import (
    data_set_of,
    is_metric_export,
    lost_rows,
    rows_of,
    split_of,
    unnamed_images,
)
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    first_bytes,
    fisheye_intrinsics,
    from_arkit,
    inside,
    json_of,
    number,
    numbers,
    refuse_unreadable,
    row_major_pose,
    seconds_to_ns,
    whole,
)
from groundwalk.geometry.poses import Array, inverse, rigidity_error

_FILE = "transforms.json"
_MODELS = ("OPENCV", "PINHOLE", "OPENCV_FISHEYE")
# OpenCV's order.
_DISTORTION, _FISHEYE = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_RIGID_TOLERANCE = 1e-3


def _is_data_set(path: Path) -> bool:
    start = first_bytes(path / _FILE)
    return bool(start) and b'"timestamp"' not in start


def detect(path: Path) -> bool:
    """A folder with a transforms.json that has no times, or one of its folders of images."""
    return data_set_of(path, _is_data_set) is not None


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the frames of one recording."""
    data_set = data_set_of(path, _is_data_set) or path
    content = json_of(data_set / _FILE, limits)
    listed = content.get("frames")
    if not isinstance(listed, list):
        raise UserError("transforms.json has no frames", where=data_set / _FILE, expected="frames: a list")
    world_T_file = _undo(content, data_set / _FILE)
    by_source = {f"frame {i}": row for i, row in enumerate(listed)}
    images, nameless = [], []
    for source, row in by_source.items():
        try:
            images.append((source, _image(data_set, row)))
        except BadRow as error:
            nameless.append(Reject(session_id, source, None, f"names no image: {error}"))
    rows = rows_of(data_set, path, images)

    def read_row(source: str, row: tuple[int, Path]) -> RawFrame:
        index, image = row
        camera = content | by_source[source]
        return RawFrame(
            number=index,
            source=source,
            t_ns=seconds_to_ns(index),
            vio_T_cam=world_T_file @ from_arkit(_pose(camera)),
            image=ImageFile(image),
            intrinsics=_intrinsics(camera),
        )

    frames, unread = collect([(s, (i, image)) for i, (s, image) in enumerate(rows)], session_id, read_row)
    refuse_unreadable(path, frames, unread, "file_path, transform_matrix, fl_x, fl_y, cx, cy, w, h")
    ours = is_metric_export(data_set)
    # Rows without an image are of no folder: they are listed once, with the first image's recording.
    unread += nameless if images and images[0] in rows else []
    unread += unnamed_images(session_id, [image for _, image in rows])
    return RawSession(
        session_id,
        FORMAT.id,
        "unknown",
        Clock.NAME_ORDER,
        path,
        frames,
        unread,
        pose_source=PoseSource.REFERENCE,
        is_gravity_aligned=ours,
        is_metric=ours,
        split=split_of([image for _, image in rows], _tested(data_set, content)),
        notes=lost_rows(images),
    )


def _image(data_set: Path, row: Any) -> Path:
    if not isinstance(row, dict):
        raise BadRow("frame is no object")
    image = inside(data_set, row.get("file_path"))
    return image if image.suffix else image.with_name(image.name + ".png")


def _tested(data_set: Path, content: dict[str, Any]) -> set[Path]:
    names = content.get("test_filenames")
    return {data_set / name for name in names if isinstance(name, str)} if isinstance(names, list) else set()


def _pose(row: dict[str, Any]) -> Array:
    pose = row_major_pose(numbers(row, "transform_matrix", 16))
    # Beyond what a pose may be, a product with it would only warn; import rejects it by its own numbers.
    if not (np.abs(pose) < 1e9).all():
        raise BadRow("transform_matrix has a value that isn't finite or is too large")
    return pose


def _undo(content: dict[str, Any], file: Path) -> Array:
    """World of the poses before `applied_transform`, from the file's world (4, 4)."""
    if content.get("applied_transform") is None:
        return np.eye(4)
    try:
        applied = row_major_pose(numbers(content, "applied_transform", 12))
        if not rigidity_error(applied) < _RIGID_TOLERANCE:
            raise BadRow("applied_transform isn't rigid")
    except BadRow as error:
        raise UserError(
            "the world of transforms.json isn't known", where=file, found=error, expected="a rigid 3x4 matrix"
        ) from None
    return inverse(applied)


def _intrinsics(row: dict[str, Any]) -> Intrinsics:
    model = row.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise BadRow(f"camera_model {str(model)[:40]} is none of {', '.join(_MODELS)}")
    fx, fy, cx, cy = (number(row, key) for key in ("fl_x", "fl_y", "cx", "cy"))
    width, height = whole(row, "w"), whole(row, "h")
    if model == "OPENCV_FISHEYE":
        return fisheye_intrinsics((fx, fy, cx, cy), width, height, _coefficients(row, _FISHEYE))
    if row.get("k4"):
        raise BadRow("distortion k4 has no place in OpenCV's model of k1, k2, p1, p2, k3")
    distortion = _coefficients(row, _DISTORTION)
    known = distortion if model == "OPENCV" and any(distortion) else ()
    return Intrinsics(fx, fy, cx, cy, width, height, known)


def _coefficients(row: dict[str, Any], keys: Sequence[str]) -> tuple[float, ...]:
    return tuple(number(row, key) if key in row else 0.0 for key in keys)


FORMAT = Format(
    id="nerfstudio",
    label="nerfstudio transforms.json",
    meaning="images, reference poses",
    looks_for="transforms.json without times",
    detect=detect,
    read=read,
)
