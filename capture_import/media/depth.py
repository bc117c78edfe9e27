"""Depth images of the selected frames: checked, and used in the capture or written to the artefact like images.

Those in metres as floats aren't PNGs but LZFSE-compressed arrays or OpenEXR images, whose decoders are the user's
choice. pyliblzfse, which is Apple's own code, has to be compiled on Linux. OpenCV has OpenEXR's, but turned off, as a
crafted file can harm it (https://github.com/opencv/opencv/issues/21326).
"""

import hashlib
import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Reject
from groundwalk.capture_import.media.images import BadImage, decoded, image_size
from groundwalk.capture_import.media.placing import Placement
from groundwalk.store.choices import Rejected
from groundwalk.store.parallel import in_parallel

# Depth images are small; a larger file isn't one.
_MAX_BYTES = 1 << 26
# Rounding of sizes: 256x192 for 1920x1440, 256x144 for 1920x1080.
_ASPECT_TOLERANCE = 0.02
_FLOAT_SUFFIXES = (".depth", ".conf", ".exr")
_LZFSE_START = b"bvx"
_EXR_START = b"\x76\x2f\x31\x01"
_EXR_SWITCH = "OPENCV_IO_ENABLE_OPENEXR"
_UNITS_PER_M = 1000  # of the depth images that are written
_MAX_MM = np.iinfo(np.uint16).max
_RED = 2  # OpenCV's order is blue, green, red


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
        is_scaled = kind == "depth" and depth.units_per_m != _UNITS_PER_M
        if is_scaled:
            pixels = np.round(pixels * (_UNITS_PER_M / depth.units_per_m)).clip(0, _MAX_MM).astype(np.uint16)
        if is_scaled or file.suffix != ".png":
            data = cv2.imencode(".png", pixels)[1].tobytes()
        elif where.stays(file):
            columns[kind] = file.relative_to(where.root).as_posix()
        if kind not in columns:
            columns[kind] = where.write(data, kind, image.number, ".png")
        if kind == "depth":
            columns["depth_sha256"] = hashlib.sha256(data).hexdigest()
    return columns


def _decode(file: Path, raw: bytes, dtype: np.dtype[Any], size: tuple[int, int], max_megapixels: float) -> NDArray[Any]:
    """Pixels (H, W) of a depth image, in millimetres, or of a confidence image."""
    if file.suffix in _FLOAT_SUFFIXES:
        if missing := missing_decoder(file):
            raise BadImage(f"can't be decoded: {missing}")
        if file.suffix == ".conf":
            return _of_lzfse(raw, dtype, size)
        metres = _of_exr(raw) if file.suffix == ".exr" else _of_lzfse(raw, np.dtype("<f4"), size)
        with np.errstate(invalid="ignore", over="ignore"):
            rounded = np.round(1000 * metres.astype(np.float64))
        # 0 where there is no depth, or more than 16 bits hold.
        return np.where((rounded > 0) & (rounded <= _MAX_MM), rounded, 0).astype(np.uint16)
    image_size(raw, max_megapixels)
    pixels = decoded(raw, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != dtype or pixels.ndim != 2:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise BadImage(f"has {channels} channels of {8 * pixels.itemsize} bits, not 1 of {8 * dtype.itemsize}")
    return pixels


def missing_decoder(file: Path) -> str | None:
    """What is missing to read a `.depth`, `.conf` or `.exr` file, and what to do; None where nothing is."""
    if file.suffix == ".exr":
        is_on = os.environ.get(_EXR_SWITCH, "0").lower() in ("1", "on", "true")
        return None if is_on else f"set {_EXR_SWITCH}=1 to let OpenCV decode EXR files, of captures that you trust"
    return None if find_spec("liblzfse") else "LZFSE's decoder isn't installed: pip install 'groundwalk[record3d]'"


def _of_lzfse(data: bytes, dtype: np.dtype[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Pixels (H, W) of an image shaped like that of `size` (width, height), which the file doesn't state.

    Raises BadImage for data that can't be decoded, or is no such image.
    """
    import liblzfse

    if not data.startswith(_LZFSE_START):
        raise BadImage("isn't compressed by LZFSE")
    try:
        raw = liblzfse.decompress(data)
    except (liblzfse.error, MemoryError):
        raise BadImage("is broken: it can't be decoded") from None
    count = len(raw) // dtype.itemsize
    width = max(1, round(np.sqrt(count * size[0] / size[1])))
    if not count or width * (count // width) * dtype.itemsize != len(raw):
        raise BadImage(f"has {len(raw)} bytes, no image of {8 * dtype.itemsize} bits shaped like {size[0]}x{size[1]}")
    return np.frombuffer(raw, dtype).reshape(-1, width)


def _of_exr(data: bytes) -> NDArray[Any]:
    """Pixels (H, W), float32, of an OpenEXR image's only channel, or of its red one; BadImage where it can't be
    decoded."""
    if not data.startswith(_EXR_START):
        raise BadImage("is no OpenEXR file")
    pixels = decoded(data, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != np.float32:
        raise BadImage(f"has {8 * pixels.itemsize} bits, not 32")
    return np.asarray(pixels if pixels.ndim == 2 else pixels[..., _RED])
