"""Small copies of images, for the recording."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from groundwalk.capture_import.images import decode_rgb, shrunk

T = TypeVar("T")

# More images of a session would make the recording of a long walk slow to open.
MAX_THUMBNAILS = 300
_LONG_SIDE = 320
_QUALITY = 70


def encode_thumbnail(rgb: NDArray[np.uint8]) -> bytes:
    """The small JPEG of an image (H, W, 3)."""
    small = np.ascontiguousarray(shrunk(rgb, _LONG_SIDE))
    return bytes(simplejpeg.encode_jpeg(small, quality=_QUALITY, colorsubsampling="420"))


def thumbnail_of(path: Path) -> bytes:
    """The small JPEG of an image file."""
    return encode_thumbnail(decode_rgb(path.read_bytes(), _LONG_SIDE))


def spread(items: Sequence[T]) -> Sequence[T]:
    """Evenly spread items, at most as many as the Rerun recording shows."""
    return items[:: max(1, math.ceil(len(items) / MAX_THUMBNAILS))]
