"""COLMAP: a model (`cameras` and `images`, `.bin` or `.txt`) in `sparse/0/`, `sparse/` or the folder, over images; or
in the same places of a folder `colmap`, `distorted`, `output` or `model` beside them.

https://colmap.github.io/format.html. What matters:

- a pose is world to camera, with our camera axes and pixel centres at 0.5: a reference without unit or up, but for our
  own exports; frames have no times. Rigs aren't needed, as each image has its own pose;
- a camera without coefficients states that there is no distortion only where COLMAP's `image_undistorter` made the
  images, which leaves `stereo/` and `run-colmap-*.sh` beside them, or where a folder beside the model is named so; of
  images as a lens took them it says nothing. Fisheye models become FULL_OPENCV's coefficients;
- without `single_camera` COLMAP gives each image a camera of its own, though one phone took them all: where their focal
  lengths are alike, they're taken for one, of the medians;
- where `sparse/` holds several models, each has a world of its own: the largest is read, of our own exports all;
- `test.txt`, which our exports write, says which images are for testing.

Each folder of images in the images' folder is a recording. Models aren't read by pycolmap, which may hang over a
damaged one.
"""

import functools
import os
import struct
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import compress, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from groundwalk.capture_import import data_sets, parsing
from groundwalk.capture_import.capture import Intrinsics, Limits, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.poses import Array, inverse
from groundwalk.store import UserError

# Numbers of parameters and of the focal lengths among them, by the binary format's numbers (COLMAP's
# src/colmap/sensor/models.h). Behind the principal point follow coefficients of OpenCV's model, or of its fisheye
# model; those of a model without focal lengths here are none.
_MODELS = {
    "SIMPLE_PINHOLE": (3, 1),
    "PINHOLE": (4, 2),
    "SIMPLE_RADIAL": (4, 1),
    "RADIAL": (5, 1),
    "OPENCV": (8, 2),
    "OPENCV_FISHEYE": (8, 2),
    "FULL_OPENCV": (12, 2),
    "FOV": (5, 0),
    "SIMPLE_RADIAL_FISHEYE": (4, 1),
    "RADIAL_FISHEYE": (5, 1),
    "THIN_PRISM_FISHEYE": (12, 0),
}
_LONGEST_NAME = 1 << 12
# Of images without distortion, beside their model.
_UNDISTORTED = ("stereo", "run-colmap-*.sh", "*undistorted*")
# Folders of tools in which a model lies while its images lie beside them: nerfstudio, 3D Gaussian splatting, scripts.
_WORKSPACES = ("colmap", "distorted", "output", "model")
# Cameras of one image each are one camera where so many have a focal length this close to the median, about which they
# scatter by no more than this (one standard deviation). Beyond the second scatter the median is uncertain by it, beyond
# that of k1 distortion isn't known. Pinholes whose focal lengths scatter by less are as a phone logged them, for each
# image.
_MIN_CAMERAS, _ALIKE_SHARE, _ALIKE_FOCAL, _ALIKE_SCATTER = 3, 0.8, 0.15, 0.05
_LOGGED_SCATTER, _SURE_SCATTER, _MAX_K1_SCATTER = 0.01, 0.03, 0.02


class _Camera(NamedTuple):
    model: str
    width: int
    height: int
    params: tuple[float, ...]
    focal_sd: float = 0.0


class _Image(NamedTuple):
    name: str
    camera: int
    xyzw: tuple[float, ...]
    translation: tuple[float, ...]


class _Model(NamedTuple):
    """A model's cameras by their numbers, its images, and notes on it."""

    cameras: dict[int, _Camera]
    images: list[_Image]
    notes: list[str]


class _DataSet(NamedTuple):
    """A folder with models, by their folders, the largest first, and the folder in which the images of that one lie."""

    models: dict[Path, _Model]
    images: Path


def _images_of(path: Path) -> Path | None:
    """A data set's folder of images; None where there is no model."""
    try:
        data_set = _read_data_set(path, Limits())
    except UserError:  # `read` says what is wrong with the model
        return path / "images"
    return data_set.images if data_set else None


def _read_data_set(path: Path, limits: Limits) -> _DataSet | None:
    """What a folder's models hold; None where it has none, nor a workspace in it one of images that lie beside that."""
    for workspace in (path, *(path / name for name in _WORKSPACES)):
        sparse = workspace / "sparse"
        below = parsing.in_order(p for p in sparse.iterdir() if p.is_dir()) if sparse.is_dir() else []
        if folders := tuple(folder for folder in (*below, sparse, workspace) if _suffix_in(folder)):
            files = [file for folder in folders for name in ("cameras.*", "images.*") for file in folder.glob(name)]
            data_set = _read_models(path, folders, limits, tuple(f.stat().st_mtime_ns for f in (path, *files)))
            largest = next(iter(data_set.models.values()))
            if workspace == path or data_sets.count_in(data_set.images, (image.name for image in largest.images)):
                return data_set
    return None


def _suffix_in(folder: Path) -> str:
    """The suffix of the model's files in a folder, binary where both kinds are there, as COLMAP does; empty: none."""
    has = ((s, (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file()) for s in (".bin", ".txt"))
    return next((suffix for suffix, is_there in has if is_there), "")


@functools.lru_cache(maxsize=2)  # each folder of images asks for its data set, some thousand times where there are many
def _read_models(path: Path, folders: tuple[Path, ...], limits: Limits, written: tuple[int, ...]) -> _DataSet:
    """`written`: when the folder's entries and its models' files last changed."""
    models = {folder: _read_model(folder, limits) for folder in folders}
    if not data_sets.is_metric_export(path):  # our own exports have each image's focal length as the phone logged it
        models = {folder: _with_shared_cameras(model) for folder, model in models.items()}
    largest_first = sorted(models, key=lambda folder: -len(models[folder].images))
    images = data_sets.folder_with(path, [image.name for image in models[largest_first[0]].images])
    return _DataSet({folder: models[folder] for folder in largest_first}, images)


def detect(path: Path) -> bool:
    data_set = data_sets.data_set_of(path, _images_of)
    images = None if data_set is None else _images_of(data_set)
    return images is not None and images.is_dir()


def missing(path: Path) -> str:
    try:
        data_set = _read_data_set(path, Limits())
    except UserError:
        return "images/"
    if data_set is None:
        return ""
    return data_sets.lost_images([image.name for image in next(iter(data_set.models.values())).images])


def read(path: Path, limits: Limits) -> Recording:
    folder = data_sets.data_set_of(path, _images_of) or path
    data_set = _read_data_set(folder, limits)
    assert data_set is not None  # `detect` has seen a model
    (largest, model), *others = data_set.models.items()
    is_undistorted = any(any(folder.glob(name)) for name in _UNDISTORTED)
    notes, used = [], data_set.models
    if not data_sets.is_metric_export(folder):
        used = {largest: model}
        # Not those of the same images, which COLMAP's own layouts have.
        names = {image.name for image in model.images}
        apart = {f: len(m.images) for f, m in others if not names.issuperset(image.name for image in m.images)}
        counts = ", ".join(f"{other.relative_to(folder)} ({count})" for other, count in apart.items())
        if apart:
            notes.append(
                f"{largest.relative_to(folder)} is read, the model with most images ({len(names)}); each has a world "
                f"of its own, so these aren't: {counts}"
            )
        notes.extend(model.notes)
    by_source = {
        f"{f.name} {image.name}": (image, m.cameras.get(image.camera)) for f, m in used.items() for image in m.images
    }
    try:
        rows = [(source, parsing.inside(data_set.images, row[0].name), row) for source, row in by_source.items()]
    except parsing.BadRow as error:
        raise UserError("an image of the model leads elsewhere", where=folder, found=error) from None
    test_list = folder / "test.txt"  # our exports write it
    listed = parsing.lines_of(test_list, limits) if test_list.is_file() else []
    tested = data_sets.named_for_testing([data_set.images], (line for _, line in listed))

    def read_row(_: Path, row: tuple[_Image, _Camera | None]) -> tuple[Array, Intrinsics]:
        image, camera = row
        if camera is None:
            raise parsing.BadRow(f"the model has no camera {image.camera}")
        cam_T_world = parsing.quaternion_pose(image.translation, image.xyzw)
        if not (np.abs(cam_T_world) < 1e100).all():
            raise parsing.BadRow("pose has a value that isn't finite or is too large")
        stated = _intrinsics(camera)
        if is_undistorted and not stated.distortion:
            stated = replace(stated, distortion=data_sets.NO_DISTORTION)
        return inverse(cam_T_world), stated

    return data_sets.read_reference(path, folder, rows, read_row, tested, notes)


def _with_shared_cameras(found: _Model) -> _Model:
    """The model, in which cameras of one image each that are alike have the same parameters; a note says so."""
    uses = Counter(image.camera for image in found.images)
    alone = defaultdict[tuple[str, int, int], list[int]](list)
    for number, camera in found.cameras.items():
        count, focal = _MODELS.get(camera.model, (0, 0))
        if uses[number] == 1 and focal and len(camera.params) == count:
            alone[camera.model, camera.width, camera.height].append(number)
    joined, said = dict[int, _Camera](), list[str]()
    for (model, width, height), numbers in alone.items():
        params = np.array([found.cameras[number].params for number in numbers])
        alike = np.abs(params[:, 0] / np.median(params[:, 0]) - 1) < _ALIKE_FOCAL
        if alike.sum() < max(_MIN_CAMERAS, _ALIKE_SHARE * len(numbers)):
            continue
        middle = np.median(params[alike], axis=0)
        scatter = 1.4826 * np.median(np.abs(params[alike] - middle), axis=0)
        focal_scatter, rest = float(scatter[0] / middle[0]), _MODELS[model][1] + 2
        least = 0 if rest < params.shape[1] else _LOGGED_SCATTER
        are_estimates = least <= focal_scatter <= _ALIKE_SCATTER and np.ptp(params, axis=0).any()
        if not are_estimates:
            continue
        if (scatter[rest : rest + 1] > _MAX_K1_SCATTER).any():
            middle[rest:] = 0
        focal_sd = focal_scatter if focal_scatter > _SURE_SCATTER else 0.0
        camera = _Camera(model, width, height, tuple(middle.tolist()), focal_sd)
        joined |= dict.fromkeys(compress(numbers, alike), camera)
        said.append(
            f"{width}x{height}, focal length {middle[0]:.0f} px (theirs scatter by {100 * focal_scatter:.1f} %)"
        )
    if not said:
        return found
    taken_for = f"a single one of {said[0]}" if len(said) == 1 else f"{len(said)}, such as one of {said[0]}"
    notes = [*found.notes, f"{len(joined)} images have a camera each: taken for {taken_for}"]
    return found._replace(cameras=found.cameras | joined, notes=notes)


def _read_model(folder: Path, limits: Limits) -> _Model:
    suffix, most = _suffix_in(folder), limits.max_rows
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    try:
        if suffix == ".bin":
            with cameras.open("rb") as file:
                by_number = dict(islice(_binary_cameras(file), most + 1))
            with images.open("rb") as file:
                listed = list(islice(_binary_images(file), most + 1))
        else:
            by_number = dict(_text_cameras([line for _, line in parsing.lines_of(cameras, limits)]))
            listed = list(islice(_text_images(line for _, line in parsing.numbered_lines(images, limits)), most + 1))
        if max(len(by_number), len(listed)) > most:
            raise parsing.BadRow(f"more than {most} cameras or images")
    except (parsing.BadRow, struct.error, OSError) as error:
        raise UserError(
            "a COLMAP model can't be read",
            where=folder,
            expected=f"cameras{suffix} and images{suffix} as COLMAP writes them",
            found=error,
            do="write it again with colmap model_converter",
        ) from None
    return _Model(by_number, listed, [])


def _binary_cameras(file: BinaryIO) -> Iterator[tuple[int, _Camera]]:
    names = list(_MODELS)
    for _ in range(*_take(file, "<Q")):
        number, model, width, height = _take(file, "<IiQQ")
        if not 0 <= model < len(names):
            raise parsing.BadRow(f"cameras.bin has a camera model of number {model}, whose length isn't known")
        yield number, _Camera(names[model], width, height, _take(file, f"<{_MODELS[names[model]][0]}d"))


def _binary_images(file: BinaryIO) -> Iterator[_Image]:
    size = os.fstat(file.fileno()).st_size
    for _ in range(*_take(file, "<Q")):
        _, qw, qx, qy, qz, tx, ty, tz, camera = _take(file, "<I7dI")
        start = file.tell()
        encoded, end_of_name, _ = file.read(_LONGEST_NAME).partition(b"\0")
        if not end_of_name:
            raise parsing.BadRow("images.bin has an image whose name doesn't end")
        file.seek(start + len(encoded) + 1)
        name, (points,) = encoded.decode(errors="replace"), _take(file, "<Q")
        end = file.tell() + 24 * points
        if end > size:
            raise parsing.BadRow(f"images.bin has {size} bytes, but points of {name[:60]} up to byte {end}")
        file.seek(end)
        yield _Image(name, camera, (qx, qy, qz, qw), (tx, ty, tz))


def _take(file: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _text_cameras(lines: Iterable[str]) -> Iterator[tuple[int, _Camera]]:
    for line in lines:
        fields = line.split()
        width, height, *params = parsing.split_numbers(" ".join(fields[2:])) if len(fields) > 4 else (0.0, 0.0)
        if not _is_id(fields[0]) or not (0 < width < 1e6 and 0 < height < 1e6):
            raise parsing.BadRow(f"cameras.txt has a row that isn't CAMERA_ID MODEL WIDTH HEIGHT PARAMS: {line[:60]}")
        yield int(fields[0]), _Camera(fields[1], int(width), int(height), tuple(params))


def _text_images(lines: Iterable[str]) -> Iterator[_Image]:
    lines = (line for line in lines if not line.startswith("#"))
    for line in lines:
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        if len(fields) != 10 or not _is_id(fields[8]):
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise parsing.BadRow(f"images.txt has a row that isn't {expected}: {line[:60]}")
        qw, qx, qy, qz, *translation = parsing.split_numbers(" ".join(fields[1:8]))
        yield _Image(fields[9].strip(), int(fields[8]), (qx, qy, qz, qw), tuple(translation))
        next(lines, None)  # its points


def _is_id(text: str) -> bool:
    return text.isdecimal() and len(text) < 20


def _intrinsics(camera: _Camera) -> Intrinsics:
    count, focal = _MODELS.get(camera.model, (0, 0))
    if not focal:
        usable = ", ".join(name for name, (_, focal) in _MODELS.items() if focal)
        raise parsing.BadRow(f"camera model {camera.model[:40]} is none of {usable}")
    if len(camera.params) != count:
        raise parsing.BadRow(f"camera model {camera.model} has {len(camera.params)} parameters, not {count}")
    fx, fy, (cx, cy, *rest) = camera.params[0], camera.params[focal - 1], camera.params[focal:]
    distortion = (*rest, *[0.0] * (4 - len(rest)))
    if camera.model.endswith("FISHEYE"):
        fisheye = parsing.fisheye_intrinsics((fx, fy, cx, cy), camera.width, camera.height, distortion)
        return replace(fisheye, focal_sd=camera.focal_sd)
    known = distortion if any(rest) else ()
    return Intrinsics(fx, fy, cx, cy, camera.width, camera.height, known, camera.focal_sd)


FORMAT = Format(
    id="colmap",
    label="COLMAP model",
    meaning="images, reference poses",
    files=("sparse/*/images.*|sparse/images.*|images.bin|images.txt", "images/"),
    looks_for="cameras and images (.bin or .txt) in sparse/0/, beside the folder of images",
    detect=detect,
    missing=missing,
    read=read,
    yields_to_all=True,
)
