"""Depth images of the selected frames: checked, and used in the capture or written to the artefact like images."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Reject
from groundwalk.capture_import.media.float_depth import (
    FLOAT_SUFFIXES,
    decode_exr,
    decode_lzfse,
    missing_decoder,
    to_millimetres,
)
from groundwalk.capture_import.media.images import BadImage, decoded, image_size
from groundwalk.capture_import.media.placing import Placement
from groundwalk.store.choices import Rejected
from groundwalk.store.parallel import in_parallel

# Depth images are small; a larger file isn't one.
_MAX_BYTES = 1 << 26
# Rounding of sizes: 256x192 for 1920x1440, 256x144 for 1920x1080.
_ASPECT_TOLERANCE = 0.02


def place_depths(images: Sequence[Image], where: Placement) -> tuple[list[dict[str, str]], list[Reject]]:
    """Check and place the depth images of a session's selected images: their columns `depth`, `depth_sha256` and
    `depth_confidence` of import.frames, in order, as far as there are any.

    They stay in the capture folder, or go where images go: copied, and always written to the artefact from an archive,
    where images are turned, as they are then turned, too, and as a PNG where they aren't one. One that can't be used is
    a reject; its frame stays.
    """
    placed, rejects = [], []
    for image, result in zip(images, in_parallel(lambda i: _place(i, where), images), strict=True):
        placed.append(result if isinstance(result, dict) else {})
        if isinstance(result, tuple):
            reason = f"{result[1]}; its image is used without"
            rejects.append(Reject(result[0], image.t_ns, reason, Rejected.DEPTH))
    return placed, rejects


def _place(image: Image, where: Placement) -> dict[str, str] | tuple[str, str]:
    """Where a frame's depth is; or the name of a file that can't be used, and why."""
    depth = image.depth
    if depth is None:
        return {}
    size = (image.check.width, image.check.height)
    if where.quarters % 2:  # that of the image as it was captured
        size = size[::-1]
    columns: dict[str, str] = {}
    shape: tuple[int, ...] | None = None
    for kind, file, dtype in (("depth", depth.path, np.uint16), ("depth_confidence", depth.confidence, np.uint8)):
        if file is None:
            continue
        what = f"depth {'image' if kind == 'depth' else 'confidence'}"
        try:
            data = where.reader.read(file, _MAX_BYTES)
            pixels = _decode(file, data, np.dtype(dtype), size, where.reader.limits.max_megapixels)
            height, width = pixels.shape
            if shape is not None and pixels.shape != shape:
                raise BadImage(f"is {width}x{height}, its depth image {shape[1]}x{shape[0]}")
            if abs(np.log(width / height * size[1] / size[0])) > _ASPECT_TOLERANCE:
                raise BadImage(f"is {width}x{height}, another shape than the image's {size[0]}x{size[1]}")
        except BadImage as error:
            return file.name, f"{what} {error}"
        shape = pixels.shape
        if where.quarters or file.suffix != ".png":
            data = cv2.imencode(".png", np.ascontiguousarray(np.rot90(pixels, -where.quarters)))[1].tobytes()
        elif where.stays(file):
            columns[kind] = file.relative_to(where.root).as_posix()
        if kind not in columns:
            columns[kind] = where.write(data, kind, image.number, ".png")
        if kind == "depth":
            columns["depth_sha256"] = hashlib.sha256(data).hexdigest()
    return columns


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
    image_size(data, max_megapixels)
    pixels = decoded(data, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != dtype or pixels.ndim != 2:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise BadImage(f"has {channels} channels of {8 * pixels.itemsize} bits, not 1 of {8 * dtype.itemsize}")
    return pixels
