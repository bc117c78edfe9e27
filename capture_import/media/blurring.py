"""Faces and licence plates: detected, and made unrecognisable before an image goes anywhere.

The detectors are the boosted cascades that OpenCV 4 has in its package (P. Viola and M. Jones, "Rapid object detection
using a boosted cascade of simple features", CVPR 2001); OpenCV 5 left them out. They detect frontal and side faces
and plates of European form; docs/reference/capture-formats.md says how many they miss.
"""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import cv2.data
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.media.images import shrunk
from groundwalk.capture_import.media.upright import turned_pixels
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of

Kind = Literal["face", "plate"]

# Cascade, and whether its mirror image is detected as well.
_CASCADES: tuple[tuple[Kind, str, bool], ...] = (
    ("face", "haarcascade_frontalface_default.xml", False),
    ("face", "haarcascade_profileface.xml", True),
    ("plate", "haarcascade_russian_plate_number.xml", False),
)
_MIN_SIZE: dict[Kind, tuple[int, int]] = {"face": (24, 24), "plate": (60, 12)}
_LONG_SIDE = 1920
# Detections that must agree: few, as a face that is missed costs more than a wall that is blurred.
_NEIGHBOURS = 3
# A region is widened by this fraction on every side, and has so many colours across afterwards.
_MARGIN = 0.2
_CELLS = 5


class Region(NamedTuple):
    """A rectangle of an image, in pixels."""

    kind: Kind
    x: int
    y: int
    width: int
    height: int


# Detects regions in an upright image (H, W, 3) in RGB.
Detector = Callable[[NDArray[np.uint8]], list[Region]]


class CascadeDetector:
    """OpenCV's cascades, loaded once a thread, as they can't be shared. UserError where OpenCV comes without."""

    def __init__(self) -> None:
        folder = Path(cv2.data.haarcascades)
        self._paths = [(kind, folder / name, mirrored) for kind, name, mirrored in _CASCADES]
        if not all(path.is_file() for _, path, _ in self._paths):
            raise UserError(
                "this OpenCV comes without the detectors that blur needs",
                expected="OpenCV 4, whose package has them",
                found=f"OpenCV {cv2.__version__}",
                where=folder,
                do=f"make install, which has it, or set {setting_of('import', 'blur = false')}",
            )
        self._of_thread = threading.local()

    def __call__(self, rgb: NDArray[np.uint8]) -> list[Region]:
        gray = cv2.cvtColor(shrunk(rgb, _LONG_SIDE), cv2.COLOR_RGB2GRAY)
        scale = rgb.shape[1] / gray.shape[1]
        regions = []
        for kind, cascade, mirrored in self._cascades():
            for flipped in (False, True) if mirrored else (False,):
                image = cv2.flip(gray, 1) if flipped else gray
                boxes = cascade.detectMultiScale(
                    image, scaleFactor=1.1, minNeighbors=_NEIGHBOURS, minSize=_MIN_SIZE[kind]
                )
                for x, y, width, height in boxes:
                    left = gray.shape[1] - x - width if flipped else x
                    regions.append(Region(kind, *(round(float(v) * scale) for v in (left, y, width, height))))
        return regions

    def _cascades(self) -> list[tuple[Kind, Any, bool]]:
        if not hasattr(self._of_thread, "cascades"):
            self._of_thread.cascades = [(k, cv2.CascadeClassifier(str(path)), m) for k, path, m in self._paths]
        return list(self._of_thread.cascades)


def blur_people(rgb: NDArray[np.uint8], detect: Detector, quarters: int) -> tuple[NDArray[np.uint8], list[Region]]:
    """An image (H, W, 3) with what `detect` finds made unrecognisable, and these regions.

    `quarters` clockwise turns put the image upright, as detectors know no faces that lie on their side; the image comes
    back as it was turned, the regions as they are in the upright one.
    """
    upright = turned_pixels(rgb, quarters)
    regions = detect(upright)
    if not regions:
        return rgb, []
    erased = upright.copy()
    for region in regions:
        # A few averaged colours of the region and its surroundings are left.
        margin_x, margin_y = round(region.width * _MARGIN), round(region.height * _MARGIN)
        left, top = max(0, region.x - margin_x), max(0, region.y - margin_y)
        part = erased[top : region.y + region.height + margin_y, left : region.x + region.width + margin_x]
        height, width = part.shape[:2]
        if height and width:
            cells = cv2.resize(part, (min(_CELLS, width), min(_CELLS, height)), interpolation=cv2.INTER_AREA)
            part[:] = cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)
    return turned_pixels(erased, -quarters), regions
