"""Depth images of the selected frames: checked, and used in the capture or written to the artefact like images."""

import hashlib
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, PlacedDepth, Reject
from groundwalk.capture_import.media.float_depth import (
    FLOAT_SUFFIXES,
    decode_exr,
    decode_lzfse,
    missing_decoder,
    to_millimetres,
)
from groundwalk.capture_import.media.images import BadImage, decoded, image_size
from groundwalk.capture_import.media.placement import Placement
from groundwalk.store.choices import Rejected
from groundwalk.store.parallel import in_parallel

# Depth images are small; a larger file isn't one.
_MAX_BYTES = 1 << 26
# Rounding of sizes: 256x192 for 1920x1440, 256x144 for 1920x1080.
_ASPECT_TOLERANCE = 0.02


def place_depths(images: Sequence[Image], where: Placement) -> tuple[list[PlacedDepth], list[Reject]]:
    """Check and place the depth images of a session's selected images, in their order.

    They stay in the capture folder, or go where images go: copied, and always written to the artefact from an archive,
    where images are turned, as they are then turned, too, and as a PNG where they aren't one. One that can't be used is
    a reject; its frame stays.
    """
    placed, rejects = [], []
    for image, result in zip(images, in_parallel(lambda i: _place(i, where), images), strict=True):
        if isinstance(result, PlacedDepth):
            placed.append(result)
            continue
        placed.append(PlacedDepth())
        reason = f"{result[1]}; its image is used without"
        rejects.append(Reject(result[0], image.frame.t_ns, reason, Rejected.DEPTH))
    return placed, rejects


def _place(image: Image, where: Placement) -> PlacedDepth | tuple[str, str]:
    """Where a frame's depth is; or the name of a file that can't be used, and why."""
    depth = image.frame.depth
    if depth is None:
        return PlacedDepth()
    size = (image.check.width, image.check.height)
    if where.quarters % 2:  # that of the image as it was captured
        size = size[::-1]
    entries: list[tuple[str, str]] = []
    shape: tuple[int, ...] | None = None
    for kind, file, dtype in (("depth", depth.path, np.uint16), ("depth_confidence", depth.confidence, np.uint8)):
        if file is None:
            continue
        try:
            data = _read(file, where)
            pixels = _decode(file, data, np.dtype(dtype), size, where.limits.max_megapixels)
            _check_shape(pixels, size, shape)
        except BadImage as error:
            return file.name, f"depth {'image' if kind == 'depth' else 'confidence'} {error}"
        shape = pixels.shape
        if where.quarters or file.suffix != ".png":
            data = cv2.imencode(".png", np.ascontiguousarray(np.rot90(pixels, -where.quarters)))[1].tobytes()
        elif where.stays(file):
            entries.append((file.relative_to(where.root).as_posix(), hashlib.sha256(data).hexdigest()))
            continue
        entry = where.write(data, kind, image.frame.number, ".png")
        entries.append((entry, hashlib.sha256(data).hexdigest()))
    return PlacedDepth(entries[0][0], entries[1][0] if len(entries) > 1 else None, entries[0][1])


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
