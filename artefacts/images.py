"""Images of import.frames: which file each is, and its pixels."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.artefacts.errors import UserError

Image = NDArray[np.uint8]
_IMPORTED = "import:"


def image_file(image: str, captures: Path, imported: Path) -> Path:
    """The file of a `frames.image` entry: relative to the capture folder, or to the import artefact where import copied
    the image (`import:` in front)."""
    if image.startswith(_IMPORTED):
        return imported / image.removeprefix(_IMPORTED)
    return captures / image


def read_image(path: Path) -> Image:
    """An image file as RGB (H, W, 3), as the sensor has it (a turn in the file's EXIF is left out, since poses and
    intrinsics are the sensor's). UserError where it isn't there or can't be decoded."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_BGR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        found = "a file that isn't an image" if path.exists() else "no such file"
        raise UserError("an image can't be read", where=path, found=found, do="import the capture again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
