"""Faces, and whatever else a user names: made unrecognisable before an image goes anywhere.

Faces are found by YuNet (W. Wu, H. Peng and S. Yu, "YuNet: A Tiny Millisecond-level Face Detector", Machine
Intelligence Research 2023), whose file comes with no package and which a setting names, or else by the boosted cascades
that OpenCV 4 has in its package (P. Viola and M. Jones, "Rapid object detection using a boosted cascade of simple
features", CVPR 2001; OpenCV 5 left them out), which detect frontal and side faces.
"""

import csv
import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, cast, get_args

import cv2
import cv2.data
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.capture_import.media.images import shrunk, turned_pixels
from groundwalk.capture_import.parsing import BadRow, number, read_text
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of
from groundwalk.store.text import printable

Kind = Literal["face", "plate"]

# Cascade, and whether its mirror image is detected as well.
_CASCADES = (("haarcascade_frontalface_default.xml", False), ("haarcascade_profileface.xml", True))
_MIN_SIZE = (24, 24)
_LONG_SIDE = 1920
# Detections that must agree: few, as a face that is missed costs more than a wall that is blurred.
_NEIGHBOURS = 3
# A region is widened by this fraction on every side, and has so many colours across afterwards.
_MARGIN = 0.2
_CELLS = 5
# YuNet: its certainty from which a region counts, the overlap of two that are one, and their largest number.
_FACE_SCORE, _FACE_OVERLAP, _MAX_FACES = 0.6, 0.3, 5000
_BOX = ("x", "y", "width", "height")
_MAX_BYTES = 1 << 26


class Region(NamedTuple):
    """A rectangle of an image, in pixels, and the detector's certainty, NaN where it states none."""

    kind: Kind
    x: int
    y: int
    width: int
    height: int
    score: float = math.nan


# Detects regions in an upright image (H, W, 3) in RGB.
Detector = Callable[[NDArray[np.uint8]], list[Region]]


class FaceDetector:
    """Faces by YuNet's file `face_model` (ONNX), where one is given, or by OpenCV's cascades; loaded once a thread, as
    they can't be shared. UserError where the file is none of YuNet's."""

    def __init__(self, face_model: Path | None = None) -> None:
        folder = Path(cv2.data.haarcascades)
        self._face_model = face_model
        self._paths = [] if face_model else [(folder / name, mirrored) for name, mirrored in _CASCADES]
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
            self._of_thread.cascades = [(cv2.CascadeClassifier(str(path)), m) for path, m in self._paths]
            if self._face_model:
                limits = (_FACE_SCORE, _FACE_OVERLAP, _MAX_FACES)
                self._of_thread.faces = cv2.FaceDetectorYN.create(str(self._face_model), "", (64, 64), *limits)
        small = shrunk(rgb, _LONG_SIDE)
        scale = rgb.shape[1] / small.shape[1]
        found: list[tuple[float, float, float, float, float]] = []
        if self._face_model:
            self._of_thread.faces.setInputSize(small.shape[1::-1])
            _, boxes = self._of_thread.faces.detect(cv2.cvtColor(small, cv2.COLOR_RGB2BGR))
            for x, y, width, height, *_, score in () if boxes is None else boxes.tolist():
                found.append((x, y, width, height, score))
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        for cascade, mirrored in self._of_thread.cascades:
            for flipped in (False, True) if mirrored else (False,):
                image = cv2.flip(gray, 1) if flipped else gray
                boxes = cascade.detectMultiScale(image, scaleFactor=1.1, minNeighbors=_NEIGHBOURS, minSize=_MIN_SIZE)
                for x, y, width, height in boxes:
                    found.append((gray.shape[1] - x - width if flipped else x, y, width, height, math.nan))
        return [
            Region("face", round(x * scale), round(y * scale), round(width * scale), round(height * scale), score)
            for x, y, width, height, score in found
        ]


@dataclass(frozen=True)
class Blurring:
    """What is to be blurred: in an image that `boxes` lists, by its frame_id, these; in others what `detect` finds,
    where it's given."""

    detect: Detector | None = None
    boxes: Mapping[str, list[Region]] = field(default_factory=dict)

    def looks_at(self, frame_id: str) -> bool:
        """Whether it says anything of an image."""
        return self.detect is not None or frame_id in self.boxes

    def regions(self, frame_id: str, rgb: NDArray[np.uint8], quarters: int) -> list[Region] | None:
        """The regions of an image (H, W, 3) to be blurred, None where nothing looks at it. `quarters` clockwise turns
        put it upright, as detectors know no faces that lie on their side."""
        if (given := self.boxes.get(frame_id)) is not None or self.detect is None:
            return given
        upright = turned_pixels(rgb, quarters)
        height, width = upright.shape[:2]
        regions = self.detect(upright)
        for _ in range(quarters):
            regions = [r._replace(x=r.y, y=width - r.x - r.width, width=r.height, height=r.width) for r in regions]
            width, height = height, width
        return regions


def blurred(rgb: NDArray[np.uint8], regions: Iterable[Region]) -> NDArray[np.uint8]:
    """An image (H, W, 3) with these regions made unrecognisable: a few averaged colours of each and its surroundings
    are left."""
    erased = rgb.copy()
    for region in regions:
        margin_x, margin_y = round(region.width * _MARGIN), round(region.height * _MARGIN)
        left, top = max(0, region.x - margin_x), max(0, region.y - margin_y)
        right, bottom = max(0, region.x + region.width + margin_x), max(0, region.y + region.height + margin_y)
        part = erased[top:bottom, left:right]
        height, width = part.shape[:2]
        if height and width:
            cells = cv2.resize(part, (min(_CELLS, width), min(_CELLS, height)), interpolation=cv2.INTER_AREA)
            part[:] = cv2.resize(cells, (width, height), interpolation=cv2.INTER_LINEAR)
    return erased


def write_boxes(file: Path, regions_of: Mapping[str, tuple[str, list[Region]]]) -> None:
    """Write a table (CSV) of the regions of each image that was looked at, by its frame_id with its source in the
    capture: a row a region, an empty one of an image without any."""
    no_region: list[tuple[str, ...]] = [("",) * len(Region._fields)]
    rows = [
        (frame_id, printable(source), *region)
        for frame_id, (source, regions) in regions_of.items()
        for region in (regions or no_region)
    ]
    pd.DataFrame(rows, columns=["frame_id", "source", *Region._fields]).to_csv(file, index=False)


def read_boxes(file: Path) -> dict[str, list[Region]]:
    """The regions of each image that a table as `write_boxes` writes it lists, also where a spreadsheet has written it
    anew. UserError where it is none."""
    kinds = get_args(Kind)
    boxes: dict[str, list[Region]] = {}
    try:
        lines = read_text(file, _MAX_BYTES).splitlines()
        table = csv.DictReader(lines, delimiter=";" if ";" in "".join(lines[:1]) else ",")
        if missing := [name for name in ("frame_id", "kind", *_BOX) if name not in (table.fieldnames or ())]:
            raise BadRow(f"no column {missing[0]}")
        for row in table:
            of_image, kind = boxes.setdefault(row["frame_id"], []), row["kind"]
            if not kind:
                continue
            try:
                x, y, width, height = (round(number(row, name)) for name in _BOX)
            except (ValueError, OverflowError):
                x = y = width = height = 0
            if kind not in kinds or min(width, height) < 1:
                raise BadRow(f"line {table.line_num}: {', '.join(str(row[name]) for name in ('kind', *_BOX))}")
            of_image.append(Region(cast(Kind, kind), x, y, width, height))
    except (BadRow, csv.Error) as error:
        raise UserError(
            "the boxes to be blurred can't be read",
            where=file,
            found=error,
            expected=f"a table (CSV) with frame_id, kind ({' or '.join(kinds)}; empty: no box), {', '.join(_BOX)}",
            do="correct it, or begin with import's blurred.csv",
        ) from None
    return boxes
