"""COLMAP: a model (`cameras` and `images`, `.bin` or `.txt`) in `sparse/0/`, `sparse/` or the folder, over images.

Documented at https://colmap.github.io/format.html. What matters:

- a pose is world to camera, a quaternion w, x, y, z and a translation, with our camera axes and pixel centres at 0.5;
- `images.txt` has two lines an image, the second of which may be empty; the points aren't read;
- camera models SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV are used as stated, and fisheye
  ones become FULL_OPENCV's coefficients; images of others are left out;
- nothing says what the unit is, or where up: scale and vertical are known for our own exports alone;
- the images' folder is the one in which the model's names lie: `images/`, or any other beside the model;
- where `sparse/` holds several models, each has a world of its own: the largest is read, of our own exports all;
- `test.txt`, which our exports write, says which images are for testing;
- frames have no times, and the order of names isn't one of time.

The poses are a reference, not VIO. Each folder of images in the images' folder is a recording. Models aren't read by
pycolmap, as it may hang over a damaged one.
"""

import contextlib
import functools
import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import (
    data_set_of,
    is_metric_export,
    notes_on_missing_folders,
    rows_of,
    stated_splits,
)
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_files import in_order
from groundwalk.capture_import.parsing import (
    BadRow,
    fisheye_intrinsics,
    inside,
    lines_of,
    numbered_lines,
    quaternion_pose,
    read_rows,
    seconds_to_ns,
    split_numbers,
)
from groundwalk.geometry.poses import inverse
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, PoseSource

# Name and number of parameters by the binary format's number: COLMAP's src/colmap/sensor/models.h.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
# How many focal lengths a model has, and OpenCV's coefficients (k1, k2, p1, p2, k3, ...) by their places behind.
_READ = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (3, None, None, None)),
    "RADIAL": (1, (3, 4, None, None)),
    "OPENCV": (2, (4, 5, 6, 7)),
    "FULL_OPENCV": (2, (4, 5, 6, 7, 8, 9, 10, 11)),
    # k1 to k4 of OpenCV's fisheye model.
    "SIMPLE_RADIAL_FISHEYE": (1, (3, None, None, None)),
    "RADIAL_FISHEYE": (1, (3, 4, None, None)),
    "OPENCV_FISHEYE": (2, (4, 5, 6, 7)),
}
_LONGEST_NAME = 1 << 12


@dataclass(frozen=True)
class _Camera:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    xyzw: tuple[float, ...]
    translation: tuple[float, ...]


def _model_in(folder: Path) -> bool:
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


@dataclass(frozen=True)
class _DataSet:
    """A folder with models: their cameras and images by their folders, the largest model first, and the folder in which
    the images of that one lie."""

    models: dict[Path, tuple[dict[int, _Camera], list[_Image]]]
    images: Path


def _images_of(path: Path, limits: Limits | None = None) -> Path | None:
    """A data set's folder of images; None where there is no model."""
    if not (folders := _model_folders(path)):
        return None
    try:
        return _data_set(path, folders, limits or Limits(), _written(path, folders)).images
    except UserError:  # `read` says what is wrong with the model
        return path / "images"


def _model_folders(path: Path) -> tuple[Path, ...]:
    sparse = path / "sparse"
    below = in_order(p for p in sparse.iterdir() if p.is_dir()) if sparse.is_dir() else []
    return tuple(folder for folder in (*below, sparse, path) if _model_in(folder))


def _written(path: Path, folders: Iterable[Path]) -> tuple[int, ...]:
    """When the folder's entries and its models' files last changed."""
    files = [file for folder in folders for name in ("cameras.*", "images.*") for file in folder.glob(name)]
    return tuple(file.stat().st_mtime_ns for file in (path, *files))


@functools.lru_cache(maxsize=2)  # each folder of images asks for its data set, some thousand times where there are many
def _data_set(path: Path, folders: tuple[Path, ...], limits: Limits, written: tuple[int, ...]) -> _DataSet:
    models = {folder: _read_model(folder, limits) for folder in folders}
    largest_first = sorted(models, key=lambda folder: -len(models[folder][1]))
    names = [image.name for image in models[largest_first[0]][1]]
    beside = in_order(p for p in path.iterdir() if p.is_dir() and p.name != "images" and not p.name.startswith("."))
    # Copies of other sizes (images_2) have the same names: the first that has most of them counts.
    images = max((path / "images", *beside, path), key=lambda folder: _count(folder, names))
    return _DataSet({folder: models[folder] for folder in largest_first}, images)


def _count(folder: Path, names: Iterable[str]) -> int:
    """How many images of these names are in a folder."""
    count = 0
    for name in names if folder.is_dir() else ():
        with contextlib.suppress(BadRow):  # `read` refuses names that lead elsewhere
            count += inside(folder, name).is_file()
    return count


def detect(path: Path) -> bool:
    """A folder with a model in sparse/0, sparse or itself beside a folder of its images, or a folder below that."""
    data_set = data_set_of(path, _images_of)
    images = None if data_set is None else _images_of(data_set)
    return images is not None and images.is_dir()


def read(path: Path, limits: Limits) -> Recording:
    """Read the images of one recording."""
    data_set = data_set_of(path, _images_of) or path
    ours = is_metric_export(data_set)
    folders = _model_folders(data_set)
    content = _data_set(data_set, folders, limits, _written(data_set, folders))
    largest, *others = content.models
    images: dict[str, tuple[_Image, _Camera | None]] = {}
    for folder in [largest, *others] if ours else [largest]:
        cameras, listed = content.models[folder]
        images |= {f"{folder.name} {i.name}": (i, cameras.get(i.camera)) for i in listed}
    try:
        named = [(source, inside(content.images, image.name)) for source, (image, _) in images.items()]
    except BadRow as error:
        raise UserError("an image of the model leads elsewhere", where=data_set, found=error) from None
    rows = rows_of(data_set, path, named)
    test_list = data_set / "test.txt"  # our exports write it
    tested = {content.images / line for _, line in lines_of(test_list, limits)} if test_list.is_file() else set()
    split_of = stated_splits([file for _, file in rows], tested)

    def read_row(number: int, source: str, file: Path) -> RawFrame:
        image, camera = images[source]
        if camera is None:
            raise BadRow(f"the model has no camera {image.camera}")
        cam_T_world = quaternion_pose(image.translation, image.xyzw)
        if not (np.abs(cam_T_world) < 1e100).all():
            raise BadRow("pose has a value that isn't finite or is too large")
        return RawFrame(
            number=number,
            source=source,
            t_ns=seconds_to_ns(number),
            vio_T_cam=inverse(cam_T_world),
            image=ImageFile(file),
            intrinsics=_intrinsics(camera),
            split=split_of.get(file),
        )

    frames, rejects = read_rows(rows, read_row)
    return Recording(
        "unknown",
        Clock.NAME_ORDER,
        path,
        frames,
        rejects,
        pose_source=PoseSource.REFERENCE,
        is_gravity_aligned=ours,
        is_metric=ours,
        notes=[*notes_on_missing_folders(named), *([] if ours else _other_models(content, data_set))],
    )


def _other_models(content: _DataSet, data_set: Path) -> list[str]:
    """A note on models that aren't read, but for those of the same images, which COLMAP's own layouts have."""
    (largest, (_, images)), *others = content.models.items()
    names = {image.name for image in images}
    apart = {f: len(i) for f, (_, i) in others if not names.issuperset(image.name for image in i)}
    if not apart:
        return []
    listed = ", ".join(f"{folder.relative_to(data_set)} ({count})" for folder, count in apart.items())
    return [
        f"{largest.relative_to(data_set)} is read, the model with most images ({len(images)}); each has a world of its "
        f"own, so these aren't: {listed}"
    ]


def _read_model(folder: Path, limits: Limits) -> tuple[dict[int, _Camera], list[_Image]]:
    """Cameras by their number, and images; the binary files where both kinds are there, as COLMAP does."""
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    most = limits.max_rows
    try:
        if binary:
            with cameras.open("rb") as file:
                by_number = dict(islice(_binary_cameras(file), most + 1))
            with images.open("rb") as file:
                listed = list(islice(_binary_images(file), most + 1))
        else:
            by_number = dict(_text_cameras([line for _, line in lines_of(cameras, limits)]))
            listed = list(islice(_text_images(line for _, line in numbered_lines(images, limits)), most + 1))
        if max(len(by_number), len(listed)) > most:
            raise BadRow(f"more than {most} cameras or images")
    except (BadRow, struct.error, UnicodeDecodeError, OSError) as error:
        raise UserError(
            "a COLMAP model can't be read",
            where=folder,
            expected=f"cameras{suffix} and images{suffix} as COLMAP writes them",
            found=error,
            do="write it again with colmap model_converter",
        ) from None
    return by_number, listed


def _binary_cameras(file: BinaryIO) -> Iterator[tuple[int, _Camera]]:
    (count,) = _take(file, "<Q")
    for _ in range(count):
        number, model, width, height = _take(file, "<IiQQ")
        if model not in _MODELS:
            raise BadRow(f"cameras.bin has a camera model of number {model}, whose length isn't known")
        name, params = _MODELS[model]
        yield number, _Camera(name, width, height, _take(file, f"<{params}d"))


def _binary_images(file: BinaryIO) -> Iterator[_Image]:
    size = os.fstat(file.fileno()).st_size
    (count,) = _take(file, "<Q")
    for _ in range(count):
        _, qw, qx, qy, qz, tx, ty, tz, camera = _take(file, "<I7dI")
        name = _name(file)
        (points,) = _take(file, "<Q")
        end = file.tell() + 24 * points
        if end > size:
            raise BadRow(f"images.bin has {size} bytes, but points of {name[:60]} up to byte {end}")
        file.seek(end)
        yield _Image(name, camera, (qx, qy, qz, qw), (tx, ty, tz))


def _take(file: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _name(file: BinaryIO) -> str:
    name = bytearray()
    while (character := file.read(1)) != b"\0":
        if not character or len(name) == _LONGEST_NAME:
            raise BadRow("images.bin has an image whose name doesn't end")
        name += character
    return name.decode()


def _text_cameras(lines: Iterable[str]) -> Iterator[tuple[int, _Camera]]:
    for line in lines:
        fields = line.split()
        width, height, *params = split_numbers(" ".join(fields[2:])) if len(fields) > 4 else (0.0, 0.0)
        if not _is_id(fields[0]) or not (0 < width < 1e6 and 0 < height < 1e6):
            raise BadRow(f"cameras.txt has a row that isn't CAMERA_ID MODEL WIDTH HEIGHT PARAMS: {line[:60]}")
        yield int(fields[0]), _Camera(fields[1], int(width), int(height), tuple(params))


def _text_images(lines: Iterable[str]) -> Iterator[_Image]:
    lines = (line for line in lines if not line.startswith("#"))
    for line in lines:
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        if len(fields) != 10 or not _is_id(fields[8]):
            raise BadRow(f"images.txt has a row that isn't IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME: {line[:60]}")
        qw, qx, qy, qz, *translation = split_numbers(" ".join(fields[1:8]))
        yield _Image(fields[9].strip(), int(fields[8]), (qx, qy, qz, qw), tuple(translation))
        next(lines, None)  # its points


def _is_id(text: str) -> bool:
    return text.isdecimal() and len(text) < 20


def _intrinsics(camera: _Camera) -> Intrinsics:
    if camera.model not in _READ:
        raise BadRow(f"camera model {camera.model[:40]} is none of {', '.join(_READ)}")
    focal, places = _READ[camera.model]
    length = max([focal + 2, *(p + 1 for p in places if p is not None)])
    if len(camera.params) != length:
        raise BadRow(f"camera model {camera.model} has {len(camera.params)} parameters, not {length}")
    fx, fy, (cx, cy) = camera.params[0], camera.params[focal - 1], camera.params[focal : focal + 2]
    distortion = tuple(0.0 if place is None else camera.params[place] for place in places)
    if camera.model.endswith("FISHEYE"):
        return fisheye_intrinsics((fx, fy, cx, cy), camera.width, camera.height, distortion)
    return Intrinsics(fx, fy, cx, cy, camera.width, camera.height, distortion if any(distortion) else ())


FORMAT = Format(
    id="colmap",
    label="COLMAP model",
    meaning="images, reference poses",
    files=("sparse/*/images.*|sparse/images.*|images.bin|images.txt", "images/|*/*.jpg|*/*.png"),
    looks_for="cameras and images (.bin or .txt) in sparse/0/, beside the folder of images",
    detect=detect,
    read=read,
)
