"""nerfstudio: `transforms.json` over images, with poses from SfM.

https://docs.nerf.studio/quickstart/data_conventions.html, and what other tools write:

- `transform_matrix` is camera to world with OpenGL's camera axes, which are ARKit's: a reference; where somebody scaled
  the world with the whole matrix, its rotation is taken without that factor;
- `applied_transform` (3x4) took the poses from an earlier world to the file's; it's undone;
- intrinsics are at the top or, going before these, each frame's own, or a matrix `K`; `camera_angle_x` gives a missing
  focal length (instant-ngp's files and NeRF's synthetic scenes). PINHOLE states that there is no distortion; zeros of
  OPENCV, which tools write of phones' images, too, state nothing. `is_fisheye` is instant-ngp's OPENCV_FISHEYE;
- nothing says what the unit is, or where up, and frames have no times;
- `test_filenames` say which images are for testing, or `transforms_test.json`; val trains.

Each folder of images in `images/` is a recording.
"""

import contextlib
import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.capture_import import data_sets, parsing
from groundwalk.capture_import.capture import Intrinsics, Limits, Recording, Reject
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.poses import Array, inverse, make_pose, rigidity_error
from groundwalk.store import UserError

_TEST_FILE = "transforms_test.json"
_FILES = ("transforms.json", "transforms_train.json", "transforms_val.json", _TEST_FILE)
_MODELS = ("OPENCV", "PINHOLE", "OPENCV_FISHEYE")
# OpenCV's order.
_DISTORTION, _FISHEYE = ("k1", "k2", "p1", "p2", "k3"), ("k1", "k2", "k3", "k4")
_MATRICES = ("K", "intrinsics", "intrinsic_matrix")
_RIGID_TOLERANCE = 1e-3
# What is said of a recording whose cameras lack a key.
_ASSUMED = {
    "the focal length is that of camera_angle_x and the images' width": "fl_x",
    "the principal point isn't stated: the middle of the image is taken": "cx",
}


def _images_of(path: Path) -> Path | None:
    """A data set's folder of images: where rows name others, it's a recording as a whole."""
    logs = _logs(path)
    return path / "images" if logs and not _lost(logs, _written(logs)) else None


def _logs(path: Path) -> tuple[Path, ...]:
    files = [path / name for name in _FILES]
    logs = [file for file in files if file.is_file() and b'"timestamp"' not in parsing.first_bytes(file)]
    return tuple(logs[:1] if logs and logs[0].name == _FILES[0] else logs)


def _written(logs: Sequence[Path]) -> tuple[int, ...]:
    return tuple(path.stat().st_mtime_ns for path in (logs[0].parent, *logs))


@functools.lru_cache(maxsize=2)  # each folder of images asks its data set
def _lost(logs: tuple[Path, ...], written: tuple[int, ...]) -> list[Path]:
    """The images that a folder's logs name, where none of them is there; `written`: when these last changed."""
    images = []
    for log in logs:
        with contextlib.suppress(UserError):  # `read` says what is wrong with it
            frames = parsing.json_of(log, Limits()).get("frames")
            for row in frames if isinstance(frames, list) else ():
                with contextlib.suppress(parsing.BadRow):
                    images.append(_image(log.parent, row))
    return [] if any(image.is_file() for image in _moved(logs[0].parent, images)) else images


def _moved(data_set: Path, images: list[Path]) -> list[Path]:
    """Images that rows name, where none of them is there: those of the same names in another folder."""
    names = [image.name for image in images]
    if any(image.is_file() for image in images) or len(set(names)) < len(names):
        return images
    return [data_sets.folder_with(data_set, names) / name for name in names]


def missing(path: Path) -> str:
    logs = _logs(path)
    lost = _lost(logs, _written(logs)) if logs else []
    return data_sets.lost_images([image.relative_to(path).as_posix() for image in lost]) if lost else ""


def detect(path: Path) -> bool:
    return data_sets.data_set_of(path, _images_of) is not None


def read(path: Path, limits: Limits) -> Recording:
    data_set = data_sets.data_set_of(path, _images_of) or path
    rows: list[tuple[str, Path, tuple[Array, dict[str, Any]]]] = []
    nameless: list[Reject] = []
    tested: set[Path] = set()
    for file in _logs(data_set):
        content = parsing.json_of(file, limits)
        frames = content.get("frames")
        if not isinstance(frames, list):
            raise UserError(f"{file.name} has no frames", where=file, expected="frames: a list")
        world_T_file = _undo(content, file)
        for i, row in enumerate(frames):
            source = f"frame {i}" if file.name == _FILES[0] else f"{file.stem} frame {i}"
            try:
                image = _image(data_set, row)
                rows.append((source, image, (world_T_file, _with_matrix(content | row))))
            except parsing.BadRow as error:
                nameless.append(Reject(source, None, str(error)))
                continue
            if file.name == _TEST_FILE:
                tested.add(image)
        listed = content.get("test_filenames")
        tested |= data_sets.named_for_testing(_folders(data_set), listed if isinstance(listed, list) else ())

    def read_row(image: Path, row: tuple[Array, dict[str, Any]]) -> tuple[Array, Intrinsics]:
        world_T_file, stated = row
        return world_T_file @ parsing.from_arkit(_pose(stated)), _intrinsics(stated, image)

    named = [image for _, image, _ in rows]
    moved = dict(zip(named, _moved(data_set, named), strict=True))
    assumed = [note for note, key in _ASSUMED.items() if any(key not in stated for *_, (_, stated) in rows)]
    if named and moved[named[0]] != named[0]:
        folder = moved[named[0]].parent.name
        assumed.append(f"no image is where its row says: those of the same names in {folder}/ are read")
    rows = [(source, moved[image], row) for source, image, row in rows]
    tested = {moved.get(image, image) for image in tested}
    recording = data_sets.read_reference(path, data_set, rows, read_row, tested, assumed)
    # Rows without an image are of no folder: they are listed once, with the first image's recording.
    is_first = not rows or path in (data_set, rows[0][1].parent)
    return replace(recording, rejects=[*recording.rejects, *nameless]) if is_first else recording


def _with_matrix(row: dict[str, Any]) -> dict[str, Any]:
    """A row whose intrinsics are a matrix, with the keys that others have."""
    matrix = next((key for key in _MATRICES if key in row), None)
    if matrix is None or "fl_x" in row:
        return row
    (fx, _, cx), (_, fy, cy), _ = parsing.numbers(row, matrix, 9).reshape(3, 3).tolist()
    return row | {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}


def _image(data_set: Path, row: Any) -> Path:
    if not isinstance(row, dict):
        raise parsing.BadRow("frame is no object")
    return data_sets.named_image(_folders(data_set), row.get("file_path"))


def _folders(data_set: Path) -> tuple[Path, ...]:
    """What names of images are relative to: the data set, or its images' folder."""
    return data_set, data_set / "images"


def _pose(row: dict[str, Any]) -> Array:
    matrix = row.get("transform_matrix")
    count = 12 if isinstance(matrix, list) and len(matrix) == 3 else 16  # some leave the last row out
    pose = parsing.row_major_pose(parsing.numbers(row, "transform_matrix", count))
    # Beyond what a pose may be, a product with it would only warn; import rejects it by its own numbers.
    if not (np.abs(pose) < 1e100).all():
        raise parsing.BadRow("transform_matrix has a value that isn't finite or is too large")
    scale = float(np.cbrt(np.linalg.det(pose[:3, :3])))
    if scale > 0 and rigidity_error(unscaled := make_pose(pose[:3, :3] / scale, pose[:3, 3])) < _RIGID_TOLERANCE:
        return unscaled
    return pose


def _undo(content: dict[str, Any], file: Path) -> Array:
    """World of the poses before `applied_transform`, from the file's world (4, 4)."""
    if content.get("applied_transform") is None:
        return np.eye(4)
    with parsing.refused("the world of transforms.json isn't known", file, expected="a rigid 3x4 matrix"):
        applied = parsing.row_major_pose(parsing.numbers(content, "applied_transform", 12))
        if not rigidity_error(applied) < _RIGID_TOLERANCE:
            raise parsing.BadRow("applied_transform isn't rigid")
        return inverse(applied)


def _intrinsics(row: dict[str, Any], image: Path) -> Intrinsics:
    model = row.get("camera_model", "OPENCV_FISHEYE" if row.get("is_fisheye") else "OPENCV")
    if model not in _MODELS:
        raise parsing.BadRow(f"camera_model {str(model)[:40]} is none of {', '.join(_MODELS)}")
    stated = parsing.optional_size(row, ("w", "h"))
    is_complete = {"fl_x", "fl_y", "cx", "cy"} <= row.keys()
    width, height = data_sets.size_of(image) if stated[0] is None and not is_complete else stated
    fx = _focal_length(row, "x", width)
    fy = _focal_length(row, "y", height) if {"fl_y", "camera_angle_y"} & row.keys() else fx
    cx = parsing.number(row, "cx") if "cx" in row or width is None else width / 2
    cy = parsing.number(row, "cy") if "cy" in row or height is None else height / 2
    if model == "OPENCV_FISHEYE":
        width, height = data_sets.size_of(image) if width is None or height is None else (width, height)
        return parsing.fisheye_intrinsics((fx, fy, cx, cy), width, height, _coefficients(row, _FISHEYE))
    if row.get("k4"):
        raise parsing.BadRow("distortion k4 has no place in OpenCV's model of k1, k2, p1, p2, k3")
    distortion = _coefficients(row, _DISTORTION)
    known = distortion if model == "OPENCV" and any(distortion) else ()
    if model == "PINHOLE" and not any(distortion):
        known = data_sets.NO_DISTORTION
    return Intrinsics(fx, fy, cx, cy, *stated, known)


def _focal_length(row: dict[str, Any], axis: str, size: int | None) -> float:
    if f"fl_{axis}" in row or size is None:
        return parsing.number(row, f"fl_{axis}")
    if f"camera_angle_{axis}" not in row:
        raise parsing.BadRow(f"fl_{axis} is missing, and so is camera_angle_{axis}")
    angle = parsing.number(row, f"camera_angle_{axis}")
    if not 0 < angle < math.pi:
        raise parsing.BadRow(f"camera_angle_{axis} {angle:g} is no angle of view in radians")
    return size / 2 / math.tan(angle / 2)


def _coefficients(row: dict[str, Any], keys: Sequence[str]) -> tuple[float, ...]:
    return tuple(parsing.number(row, key) if key in row else 0.0 for key in keys)


FORMAT = Format(
    id="nerfstudio",
    label="nerfstudio transforms.json",
    meaning="images, reference poses",
    files=("|".join(_FILES),),
    looks_for="transforms.json without times, or transforms_train.json and transforms_test.json",
    detect=detect,
    missing=missing,
    read=read,
    yields_to=("colmap",),  # whose models have the whole distortion, and no applied_transform
    yields_to_all=True,
)
