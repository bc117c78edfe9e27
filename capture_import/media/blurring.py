"""Faces and licence plates: detected, and made unrecognisable before an image goes anywhere.

Faces are found by YuNet (W. Wu, H. Peng and S. Yu, "YuNet: A Tiny Millisecond-level Face Detector", Machine
Intelligence Research 2023), whose file comes with no package and which a setting names, or else by the boosted cascades
that OpenCV 4 has in its package (P. Viola and M. Jones, "Rapid object detection using a boosted cascade of simple
features", CVPR 2001; OpenCV 5 left them out), as plates are. Cascades detect frontal and side faces and plates of
European form.
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
# YuNet: its certainty from which a region counts, the overlap of two that are one, and their largest number.
_FACE_SCORE, _FACE_OVERLAP, _MAX_FACES = 0.6, 0.3, 5000
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


class PeopleDetector:
    """Faces by YuNet's file `face_model` (ONNX), where one is given, all else by OpenCV's cascades; loaded once a
    thread, as they can't be shared. UserError where OpenCV comes without them, or the file is none of YuNet's."""

    def __init__(self, face_model: Path | None = None) -> None:
        folder = Path(cv2.data.haarcascades)
        self._face_model = face_model
        self._paths = [
            (kind, folder / name, mirrored) for kind, name, mirrored in _CASCADES if kind == "plate" or not face_model
        ]
        if not all(path.is_file() for _, path, _ in self._paths):
            raise UserError(
                "this OpenCV comes without the detectors that blur needs",
                expected="OpenCV 4, whose package has them",
                found=f"OpenCV {cv2.__version__}",
                where=folder,
                do=f"make install, which has it, or set {setting_of('import', 'blur = false')}",
            )
        self._of_thread = threading.local()
        if face_model is None:
            return
        try:
            self(np.zeros((64, 64, 3), np.uint8))
        except cv2.error as error:
            raise UserError(
                "the face detector's file can't be used",
                where=face_model,
                expected="YuNet, as face_detection_yunet_2023mar.onnx",
                found=" ".join(str(error).split())[:200],
                do=f"correct {setting_of('import', 'face_model')} (docs/how-to/blur-faces.md says where it is)",
            ) from None

    def __call__(self, rgb: NDArray[np.uint8]) -> list[Region]:
        if not hasattr(self._of_thread, "cascades"):
            self._of_thread.cascades = [(k, cv2.CascadeClassifier(str(path)), m) for k, path, m in self._paths]
            if self._face_model:
                limits = (_FACE_SCORE, _FACE_OVERLAP, _MAX_FACES)
                self._of_thread.faces = cv2.FaceDetectorYN.create(str(self._face_model), "", (64, 64), *limits)
        small = shrunk(rgb, _LONG_SIDE)
        scale = rgb.shape[1] / small.shape[1]
        found: list[tuple[Kind, Any]] = []
        if self._face_model:
            self._of_thread.faces.setInputSize(small.shape[1::-1])
            _, boxes = self._of_thread.faces.detect(cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
            found = [("face", box[:4]) for box in (() if boxes is None else boxes)]
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        for kind, cascade, mirrored in self._of_thread.cascades:
            for flipped in (False, True) if mirrored else (False,):
                image = cv2.flip(gray, 1) if flipped else gray
                boxes = cascade.detectMultiScale(
                    image, scaleFactor=1.1, minNeighbors=_NEIGHBOURS, minSize=_MIN_SIZE[kind]
                )
                for x, *of_box in boxes:
                    found.append((kind, (gray.shape[1] - x - of_box[1] if flipped else x, *of_box)))
        return [Region(kind, *(round(float(v) * scale) for v in box)) for kind, box in found]


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
