"""Where the kept images are: in the capture as they are, or in the artefact."""

import hashlib
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from artefacts import UserError
from capture_import.capture import ImageFile, Limits, VideoFrame
from capture_import.images import decode_rgb
from capture_import.intake import Image
from capture_import.upright import turned_pixels
from capture_import.video import decode

# For what is compressed once more: video frames and turned images.
_QUALITY = 95


@dataclass(frozen=True)
class Placed:
    """An image's `frames.image` entry and the hash of its file."""

    entry: str
    sha256: str


def place_images(
    images: Sequence[Image],
    session_id: str,
    root: Path,
    work: Path,
    how: Literal["reference", "copy", "link"],
    quarters: int,
    limits: Limits,
) -> list[Placed]:
    """Place a session's kept images, in order.

    Frames of a video, images from an archive, and images to be turned by quarters clockwise are always written to
    `work`; other files of the capture folder `root` are left there, copied or hard-linked.
    """
    folder = work / "images" / session_id
    video = [image.frame.image for image in images if isinstance(image.frame.image, VideoFrame)]
    if video:
        decoded = decode(video[0].path, {ref.index for ref in video}, limits, gray=False)
        return _write_jpegs(images, (rgb for _, rgb in decoded), folder, work, quarters)
    if quarters:
        files = [image.frame.image.path for image in images if isinstance(image.frame.image, ImageFile)]
        full = (decode_rgb(path.read_bytes(), long_side=2**31) for path in files)
        return _write_jpegs(images, full, folder, work, quarters)
    return [_place_file(image, root, folder, work, how) for image in images]


def _place_file(image: Image, root: Path, folder: Path, work: Path, how: str) -> Placed:
    ref = image.frame.image
    assert isinstance(ref, ImageFile)  # place_images has seen to the videos
    in_capture = ref.path.is_relative_to(root)
    if how == "reference" and in_capture:
        return Placed(ref.path.relative_to(root).as_posix(), image.check.sha256)
    target = folder / f"{image.frame.number:06d}{ref.path.suffix.lower()}"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # from a killed run
    if how == "link" and in_capture:
        try:
            os.link(ref.path.resolve(), target)
        except OSError as error:
            raise UserError(
                "an image can't be hard-linked",
                where=ref.path,
                found=error.strerror,
                do='set images = "copy" or "reference" in [import]',
            ) from None
    else:
        shutil.copyfile(ref.path, target)
    return Placed(_entry(target, work), image.check.sha256)


def _write_jpegs(
    images: Sequence[Image], pixels: Iterable[NDArray[np.uint8]], folder: Path, work: Path, quarters: int
) -> list[Placed]:
    folder.mkdir(parents=True, exist_ok=True)
    placed = []
    for image, rgb in zip(images, pixels, strict=True):
        data = simplejpeg.encode_jpeg(turned_pixels(rgb, quarters), quality=_QUALITY, colorsubsampling="420")
        target = folder / f"{image.frame.number:06d}.jpg"
        target.write_bytes(data)
        placed.append(Placed(_entry(target, work), hashlib.sha256(data).hexdigest()))
    return placed


def _entry(target: Path, work: Path) -> str:
    return f"import:{target.relative_to(work).as_posix()}"
