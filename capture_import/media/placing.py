"""Where the selected images are: in the capture as they are, or in the artefact."""

import contextlib
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import ImageFile, Limits, VideoFrame
from groundwalk.capture_import.intake import Image
from groundwalk.capture_import.media.blurring import Detector, Kind, blur_people
from groundwalk.capture_import.media.images import decode_rgb, encode_jpeg, without_metadata
from groundwalk.capture_import.media.spool import spooled_path
from groundwalk.capture_import.media.upright import turned_pixels
from groundwalk.capture_import.media.video import decode, rgb_pixels
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of
from groundwalk.store.parallel import in_parallel
from groundwalk.store.progress import track


@dataclass(frozen=True)
class PlacedImage:
    """An image's `frames.image` entry, the hash of its file, and what was made unrecognisable in it; None without a
    detector."""

    entry: str
    sha256: str
    blurred: tuple[Kind, ...] | None = None


@dataclass(frozen=True)
class Placement:
    """How a session's images are placed.

    `root` is the capture folder, `work` the artefact's; `spooled` holds the video frames that were written while the
    video was checked. Images are turned by `quarters` clockwise; `to_upright` quarter turns clockwise put gravity
    down.
    """

    root: Path
    work: Path
    spooled: Path
    how: Literal["reference", "copy", "link"]
    quarters: int
    to_upright: int
    limits: Limits
    detect: Detector | None = None


def place_images(images: Sequence[Image], session_id: str, where: Placement) -> list[PlacedImage]:
    """Place a session's selected images, in order.

    Frames of a video, images from an archive, and images that are turned or blurred are always written to the artefact,
    without metadata; other files of the capture folder are left there, copied or hard-linked.
    """
    folder = where.work / "images" / session_id
    folder.mkdir(parents=True, exist_ok=True)
    text = f"{session_id}: {'placing images' if where.detect is None else 'blurring faces and plates'}"
    if any(isinstance(image.frame.image, VideoFrame) for image in images):
        placed = _place_video(images, folder, where, text)
    else:
        files = in_parallel(lambda image: _place_file(image, folder, where), images)
        placed = list(track(files, text, len(images)))
    with contextlib.suppress(OSError):  # not empty
        folder.rmdir()
        folder.parent.rmdir()
    return placed


def _place_video(images: Sequence[Image], folder: Path, where: Placement, text: str) -> list[PlacedImage]:
    """`text` names the work in its progress."""
    placed: dict[int, PlacedImage] = {}
    missing: dict[int, Image] = {}
    for image in images:
        ref = image.frame.image
        assert isinstance(ref, VideoFrame)  # a recording has files or a video, never both
        ready = spooled_path(where.spooled, ref)
        if ready.is_file():
            placed[ref.index] = _write(image, ready.read_bytes(), folder, where)
        else:
            missing[ref.index] = image
    if missing:
        video = next(ref.path for image in images if isinstance(ref := image.frame.image, VideoFrame))
        frames = decode(video, set(missing), where.limits)
        rendered = in_parallel(lambda frame: (frame[0], _rendered(rgb_pixels(frame[1]), where)), frames)
        for index, (rgb, blurred) in track(rendered, text, len(missing)):
            placed[index] = _write(missing[index], encode_jpeg(rgb), folder, where, blurred)
    return [placed[i.frame.image.index] for i in images if isinstance(i.frame.image, VideoFrame)]


def _place_file(image: Image, folder: Path, where: Placement) -> PlacedImage:
    ref = image.frame.image
    assert isinstance(ref, ImageFile)  # place_images handles videos
    blurred: tuple[Kind, ...] | None = None
    if where.quarters or where.detect is not None:
        rgb, blurred = _rendered(decode_rgb(ref.path.read_bytes(), long_side=2**31), where)
        if where.quarters or blurred:
            return _write(image, encode_jpeg(rgb), folder, where, blurred)
    in_capture = ref.path.is_relative_to(where.root)
    if where.how == "reference" and in_capture:
        return PlacedImage(ref.path.relative_to(where.root).as_posix(), image.check.sha256, blurred)
    data = ref.path.read_bytes()
    pixels_only = without_metadata(data)
    if where.how == "link" and in_capture and pixels_only == data:
        return PlacedImage(_linked(ref.path, image, folder, where), image.check.sha256, blurred)
    return _write(image, pixels_only, folder, where, blurred, suffix=ref.path.suffix.lower())


def _rendered(rgb: NDArray[np.uint8], where: Placement) -> tuple[NDArray[np.uint8], tuple[Kind, ...] | None]:
    """An image as it's written, and what was blurred in it."""
    blurred: tuple[Kind, ...] | None = None
    if where.detect is not None:
        rgb, regions = blur_people(rgb, where.detect, where.to_upright)
        blurred = tuple(region.kind for region in regions)
    return turned_pixels(rgb, where.quarters), blurred


def _linked(source: Path, image: Image, folder: Path, where: Placement) -> str:
    target = folder / f"{image.frame.number:06d}{source.suffix.lower()}"
    target.unlink(missing_ok=True)  # from a killed run
    try:
        os.link(source.resolve(), target)
    except OSError as error:
        raise UserError(
            "an image can't be hard-linked",
            where=source,
            found=error.strerror,
            do="set " + setting_of("import", 'images = "copy"'),
        ) from None
    return _entry(target, where.work)


def _write(
    image: Image,
    data: bytes,
    folder: Path,
    where: Placement,
    blurred: tuple[Kind, ...] | None = None,
    suffix: str = ".jpg",
) -> PlacedImage:
    target = folder / f"{image.frame.number:06d}{suffix}"
    target.unlink(missing_ok=True)  # a hard link from a killed run must not be written through
    target.write_bytes(data)
    return PlacedImage(_entry(target, where.work), hashlib.sha256(data).hexdigest(), blurred)


def _entry(target: Path, work: Path) -> str:
    return f"import:{target.relative_to(work).as_posix()}"
