"""Depth in metres as floats, of files that aren't PNGs: LZFSE-compressed arrays and OpenEXR images.

Their decoders are the user's choice. pyliblzfse, which is Apple's own code, has to be compiled on Linux. OpenCV has
OpenEXR's, but turned off, as a crafted file can harm it (https://github.com/opencv/opencv/issues/21326).
"""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.media.images import BadImage, decoded

FLOAT_SUFFIXES = (".depth", ".conf", ".exr")
_LZFSE_START = b"bvx"
_EXR_START = b"\x76\x2f\x31\x01"
_EXR_SWITCH = "OPENCV_IO_ENABLE_OPENEXR"
_MAX_MM = np.iinfo(np.uint16).max
_RED = 2  # OpenCV's order is blue, green, red


def missing_decoder(file: Path) -> str | None:
    """What is missing to read a `.depth`, `.conf` or `.exr` file, and what to do; None where nothing is."""
    if file.suffix == ".exr":
        is_on = os.environ.get(_EXR_SWITCH, "0").lower() in ("1", "on", "true")
        return None if is_on else f"set {_EXR_SWITCH}=1 to let OpenCV decode EXR files, of captures that you trust"
    return None if find_spec("liblzfse") else "LZFSE's decoder isn't installed: pip install 'groundwalk[record3d]'"


def decode_lzfse(data: bytes, dtype: np.dtype[Any], size: tuple[int, int]) -> NDArray[Any]:
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


def decode_exr(data: bytes) -> NDArray[Any]:
    """Pixels (H, W), float32, of an OpenEXR image's only channel, or of its red one; BadImage where it can't be
    decoded."""
    if not data.startswith(_EXR_START):
        raise BadImage("is no OpenEXR file")
    pixels = decoded(data, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != np.float32:
        raise BadImage(f"has {8 * pixels.itemsize} bits, not 32")
    return np.asarray(pixels if pixels.ndim == 2 else pixels[..., _RED])


def to_millimetres(metres: NDArray[Any]) -> NDArray[np.uint16]:
    """Millimetres; 0 where there is no depth, or more than 16 bits hold."""
    with np.errstate(invalid="ignore", over="ignore"):
        rounded = np.round(1000 * metres.astype(np.float64))
    return np.where((rounded > 0) & (rounded <= _MAX_MM), rounded, 0).astype(np.uint16)
