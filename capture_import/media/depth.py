"""Depth images of the selected frames: checked, and used in the capture or written to the artefact like images."""

import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Reject
from groundwalk.capture_import.intake import Image
from groundwalk.capture_import.media.float_depth import (
    FLOAT_SUFFIXES,
    decode_exr,
    decode_lzfse,
    missing_decoder,
    to_millimetres,
)
from groundwalk.capture_import.media.images import BadImage, decoded, image_size
from groundwalk.capture_import.media.placing import Placement
from groundwalk.store import UserError
from groundwalk.store.choices import Rejected
from groundwalk.store.hints import setting_of
from groundwalk.store.parallel import in_parallel

# Depth images are small; a larger file isn't one.
_MAX_BYTES = 1 << 26
# Rounding of sizes: 256x192 for 1920x1440, 256x144 for 1920x1080.
_ASPECT_TOLERANCE = 0.02


@dataclass(frozen=True)
class PlacedDepth:
    """A frame's entries `depth` and `depth_confidence` in import.frames; None where there is none."""

    entry: str | None = None
    confidence: str | None = None


def place_depths(images: Sequence[Image], session_id: str, where: Placement) -> tuple[list[PlacedDepth], list[Reject]]:
    """Check and place the depth images of a session's selected images, in their order.

    They stay in the capture folder, or go where images go: copied, linked, and always written to the artefact from an
    archive, where images are turned, as they are then turned, too, and as a PNG where they aren't one. One that can't
    be used is a reject; its frame stays.
    """
    placed, rejects = [], []
    for image, result in zip(images, in_parallel(lambda i: _place(i, session_id, where), images), strict=True):
        if isinstance(result, PlacedDepth):
            placed.append(result)
            continue
        placed.append(PlacedDepth())
        reason = f"{result[1]}; its image is used without"
        rejects.append(Reject(session_id, result[0], image.frame.t_ns, reason, Rejected.DEPTH))
    return placed, rejects


def _place(image: Image, session_id: str, where: Placement) -> PlacedDepth | tuple[str, str]:
    """Where a frame's depth is; or the name of a file that can't be used, and why."""
    depth = image.frame.depth
    if depth is None:
        return PlacedDepth()
    size = (image.check.width, image.check.height)
    if where.quarters % 2:  # that of the image as it was captured
        size = size[::-1]
    entries: list[str] = []
    shape: tuple[int, ...] | None = None
    for file, dtype in ((depth.path, np.uint16), (depth.confidence, np.uint8)):
        if file is None:
            continue
        try:
            data = _read(file, where)
            pixels = _decode(file, data, np.dtype(dtype), size, where.limits.max_megapixels)
            _check_shape(pixels, size, shape)
        except BadImage as error:
            return file.name, f"depth {'image' if dtype is np.uint16 else 'confidence'} {error}"
        shape = pixels.shape
        entries.append(_placed(file, data, pixels, image, session_id, where))
    return PlacedDepth(*entries)


def _read(file: Path, where: Placement) -> bytes:
    if file.is_relative_to(where.root) and not file.resolve().is_relative_to(where.root.resolve()):
        raise BadImage("is a link out of the capture")
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):
            raise BadImage("is no ordinary file")
        if status.st_size > _MAX_BYTES:
            raise BadImage(f"is larger than {_MAX_BYTES} bytes")
        return file.read_bytes()
    except OSError as error:
        raise BadImage(f"{file.name} can't be read: {error.strerror}") from None


def _decode(
    file: Path, data: bytes, dtype: np.dtype[Any], size: tuple[int, int], max_megapixels: float
) -> NDArray[Any]:
    """Pixels (H, W) of a depth image, in millimetres, or of a confidence image."""
    if file.suffix in FLOAT_SUFFIXES:
        if missing := missing_decoder(file):
            raise BadImage(f"can't be decoded: {missing}")
        if file.suffix == ".conf":
            return decode_lzfse(data, dtype, size)
        return to_millimetres(decode_exr(data) if file.suffix == ".exr" else decode_lzfse(data, np.dtype("<f4"), size))
    width, height = image_size(data)
    if width * height > max_megapixels * 1e6:
        raise BadImage(f"of {width}x{height} is larger than {max_megapixels:g} megapixels")
    pixels = decoded(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise BadImage("is broken: it can't be decoded")
    if pixels.dtype != dtype or pixels.ndim != 2:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise BadImage(f"has {channels} channels of {8 * pixels.itemsize} bits, not 1 of {8 * dtype.itemsize}")
    return pixels


def _check_shape(pixels: NDArray[np.generic], size: tuple[int, int], shape: tuple[int, ...] | None) -> None:
    height, width = pixels.shape
    if shape is not None and pixels.shape != shape:
        raise BadImage(f"is {width}x{height}, its depth image {shape[1]}x{shape[0]}")
    if abs(np.log(width / height * size[1] / size[0])) > _ASPECT_TOLERANCE:
        raise BadImage(f"is {width}x{height}, another shape than the image's {size[0]}x{size[1]}")


def _placed(
    file: Path, data: bytes, pixels: NDArray[np.generic], image: Image, session_id: str, where: Placement
) -> str:
    """Entry of a depth or confidence image."""
    in_capture, is_png = file.is_relative_to(where.root), file.suffix == ".png"
    if where.how == "reference" and in_capture and is_png and not where.quarters:
        return file.relative_to(where.root).as_posix()
    kind = "depth" if pixels.dtype == np.uint16 else "depth_confidence"
    target = where.work / kind / session_id / f"{image.frame.number:06d}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # from a killed run
    if where.how == "link" and in_capture and is_png and not where.quarters:
        try:
            os.link(file.resolve(), target)
        except OSError as error:
            raise UserError(
                "a depth image can't be hard-linked",
                where=file,
                found=error.strerror,
                do="set " + setting_of("import", 'images = "copy"'),
            ) from None
    elif where.quarters or not is_png:
        turned = np.ascontiguousarray(np.rot90(pixels, -where.quarters))
        target.write_bytes(cv2.imencode(".png", turned)[1].tobytes())
    else:
        target.write_bytes(data)
    return f"import:{target.relative_to(where.work).as_posix()}"
