"""An image that is asked about from outside a run: the file, and what is known of its camera."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.geometry import Array
from groundwalk.geometry.cameras import Camera
from groundwalk.store.choices import ImageSide
from groundwalk.store.errors import UserError
from groundwalk.store.images import read_image

_IMAGES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
_UNREAD = {".heic", ".heif", ".avif", ".dng"}  # photos: those in a folder are refused by name
_INTRINSICS_FILE = "intrinsics.json"
_INTRINSICS = ("fx", "fy", "cx", "cy")
_CAMERA = ("width", "height", *_INTRINSICS, "first_row")
_ARKIT_POSE = "cameraPoseARFrame"
_MIN_FOCAL, _MAX_FOCAL = 0.2, 20.0  # by the longer side: from 136 degrees to 3 degrees of view
_MAX_OFF_CENTRE = 0.1  # of the longer side; phones' are within a hundredth or two
_RIGID = 1e-3


@dataclass(frozen=True)
class Query:
    """An image, RGB (H, W, 3) or grey (H, W), its camera as the phone logged it, gravity as a unit vector (3,), down,
    in the camera, and a prior map_T_cam (4, 4), either None where not known."""

    image: NDArray[np.uint8]
    camera: Camera
    gravity: Array | None
    prior: Array | None


def query_of(image: str | os.PathLike[str] | ArrayLike, known: Mapping[str, Any], where: object) -> Query:
    """A query of an image: a file, or RGB (H, W, 3) or grey (H, W), uint8, as an array or what NumPy makes one of.

    known: fx, fy, cx, cy in pixels; width and height that these are for, those of the image unless given; first_row,
    the side of the image that the sensor reads out first (top, right, bottom, left), that of phones unless given;
    gravity (3,); prior (4, 4). UserError where intrinsics lack or anything can't be what it should; `where` says where
    they belong.
    """
    pixels = _pixels(image)
    missing = [name for name in _INTRINSICS if known.get(name) is None]
    if missing:
        raise UserError(
            f"an image has no intrinsics: {', '.join(missing)}", where=where, expected="fx, fy, cx, cy in pixels"
        )
    fx, fy, cx, cy = (_number(known[name], name, where) for name in _INTRINSICS)
    width, height = (
        round(_number(known.get(name, size), name, where))
        for name, size in (("width", pixels.shape[1]), ("height", pixels.shape[0]))
    )
    longer = max(width, height, 1)
    if not (_MIN_FOCAL < fx / longer < _MAX_FOCAL and _MIN_FOCAL < fy / longer < _MAX_FOCAL):
        actual = f"{fx:g} and {fy:g} px for an image {width} x {height} px"
        raise UserError("focal lengths can't be those of this image", where=where, found=actual)
    if not (0 < cx < width and 0 < cy < height):
        actual = f"({cx:g}, {cy:g}) px for an image {width} x {height} px"
        raise UserError("the principal point isn't in the image", where=where, found=actual)
    off = max(abs(cx - width / 2), abs(cy - height / 2))
    if known.get("width") is None and known.get("height") is None and off > _MAX_OFF_CENTRE * longer:
        raise UserError(
            "the principal point is far from the image's centre, as of an image of another size or orientation",
            where=where,
            found=f"({cx:g}, {cy:g}) px for an image {width} x {height} px",
            do="give the intrinsics of this image; where it's cut out of a larger one, say width and height, too",
        )
    first_row = known.get("first_row")
    if first_row not in (None, *ImageSide):
        raise UserError("first_row is no side of an image", where=where, expected=", ".join(ImageSide), found=first_row)
    camera = Camera(width, height, fx, fy, cx, cy, first_row=first_row)
    return Query(pixels, camera, _down(known.get("gravity"), where), _prior(known.get("prior"), where))


def known_of(
    intrinsics: Camera | Mapping[str, Any] | ArrayLike | None, gravity: ArrayLike | None, prior: ArrayLike | None
) -> dict[str, Any]:
    """What `query_of` takes of an image: intrinsics as a Camera, a mapping with fx, fy, cx, cy (and width, height,
    first_row), K (3, 3), or the four numbers. UserError for something else."""
    known: dict[str, Any] = {"gravity": gravity, "prior": prior}
    if intrinsics is None:
        return known
    if isinstance(intrinsics, Camera):
        return known | {name: getattr(intrinsics, name) for name in _CAMERA}
    if isinstance(intrinsics, Mapping):
        return known | {name: intrinsics[name] for name in _CAMERA if name in intrinsics}
    try:
        numbers = np.asarray(intrinsics, float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape == (3, 3):
        numbers = numbers[[0, 1, 0, 1], [0, 1, 2, 2]]
    if numbers.shape != (4,):
        expected = "a Camera, a mapping with fx, fy, cx, cy, K (3, 3), or fx, fy, cx, cy"
        raise UserError("these are no intrinsics", found=repr(intrinsics)[:100], expected=expected)
    return known | dict(zip(_INTRINSICS, numbers.tolist(), strict=True))


def image_files(images: Path) -> list[Path]:
    """An image, or those of a folder by name; UserError where there is none."""
    if images.is_file():
        return [images]
    kinds = _IMAGES | _UNREAD
    files = sorted(path for path in images.glob("*") if path.suffix.lower() in kinds) if images.is_dir() else []
    if not files:
        kind = "no image in this folder" if images.is_dir() else "no such file or folder"
        raise UserError(
            "there are no images to localise", where=images, found=kind, expected=", ".join(sorted(_IMAGES))
        )
    return files


def file_query(path: Path, common: Mapping[str, Any]) -> Query:
    """An image with what is known of it: what the folder's file says, then the command, then the image's own file,
    which may be 3D Scanner App's of a frame. Intrinsics that say no image size are for the image's own."""
    folder, *own = [path.with_name(_INTRINSICS_FILE), path.with_name(path.name + ".json"), path.with_suffix(".json")]
    known: dict[str, Any] = {}
    for stated in (_stated(folder), common, *map(_stated, own)):
        if stated.keys() >= set(_INTRINSICS):
            known = {name: value for name, value in known.items() if name not in ("width", "height")}
        known |= stated
    where = f"{path.name}.json or {_INTRINSICS_FILE} beside {path}, or --intrinsics fx,fy,cx,cy"
    return query_of(path, known, where)


def _stated(file: Path) -> dict[str, Any]:
    """What a JSON file says of an image, nothing where there is none; 3D Scanner App's of a frame its intrinsics, and
    gravity by ARKit's pose (camera y up and z backward, world y up)."""
    if not file.is_file():
        return {}
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError("a file with intrinsics can't be read", where=file, found=error, expected="JSON") from None
    if not isinstance(content, dict):
        raise UserError("a file with intrinsics has something else", where=file, expected="a JSON object")
    if _ARKIT_POSE not in content:
        return content
    K = _array(content.get("intrinsics"), (3, 3), "intrinsics", file)
    world_T_arkit_cam = _array(content[_ARKIT_POSE], (4, 4), _ARKIT_POSE, file)
    down = -world_T_arkit_cam[1, :3] * [1, -1, -1]
    return {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "gravity": down}


def numbers(text: str, count: int, option: str) -> list[float]:
    """The value of an option that is `count` numbers with commas; UserError for another."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise UserError(
            f"{option} has something else than numbers", found=text, expected=f"{count} numbers with commas"
        )
    return values


def _pixels(image: str | os.PathLike[str] | ArrayLike) -> NDArray[np.uint8]:
    if isinstance(image, str | os.PathLike):
        path = Path(image)
        if path.suffix.lower() in _UNREAD:
            kind = f"{path.suffix}, not one of {', '.join(sorted(_IMAGES))}"
            raise UserError("an image is of a kind that can't be read", where=path, found=kind, do="convert it to JPEG")
        pixels: NDArray[Any] = read_image(path)
    else:
        pixels = np.asarray(image)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)) or not pixels.size:
        actual = f"{pixels.dtype} of shape {pixels.shape}"
        raise UserError("this isn't an image", found=actual, expected="uint8, RGB (H, W, 3) or grey (H, W)")
    return pixels


def _number(value: Any, name: str, where: object) -> float:
    number = float(value) if isinstance(value, int | float | np.number) and not isinstance(value, bool) else np.nan
    if not np.isfinite(number):
        raise UserError(f"{name} is no finite number", where=where, found=repr(value))
    return number


def _array(value: Any, shape: tuple[int, ...], name: str, where: object) -> Array:
    try:
        array = np.asarray(value, float).reshape(shape)
    except (TypeError, ValueError):
        array = np.full(shape, np.nan)
    if not np.isfinite(array).all():
        raise UserError(f"{name} isn't {shape} finite numbers", where=where, found=repr(value)[:100])
    return array


def _down(value: Any, where: object) -> Array | None:
    if value is None:
        return None
    gravity = _array(value, (3,), "gravity", where)
    length = float(np.linalg.norm(gravity))
    if length < 1e-6:
        raise UserError("gravity has no direction", where=where, found=gravity.tolist())
    return gravity / length


def _prior(value: Any, where: object) -> Array | None:
    if value is None:
        return None
    prior = _array(value, (4, 4), "prior", where)
    rotation = prior[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise UserError("the prior's rotation is none", where=where, expected="map_T_cam (4, 4), rigid")
    if not np.allclose(prior[3], [0, 0, 0, 1]):
        raise UserError("the prior isn't a pose", where=where, expected="last row 0, 0, 0, 1", found=prior[3].tolist())
    return prior
