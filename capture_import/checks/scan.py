"""One scan of every image of a recording: sound or not, size, sharpness, and a small copy."""

import stat
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import ImageFile, Limits, RawFrame, VideoFrame
from groundwalk.capture_import.media.images import (
    WORKING_LONG_SIDE,
    BadImage,
    Gray,
    ImageCheck,
    check_image,
    decode_gray,
)
from groundwalk.capture_import.media.video import decode, gray_pixels
from groundwalk.store.parallel import in_parallel

# A sound JPEG or PNG has fewer bytes than this a pixel, and a header with metadata.
_BYTES_A_PIXEL = 4
_HEADER_BYTES = 1 << 20


@dataclass(frozen=True)
class ImageScan:
    """A sound image.

    `gray` (H, W) has the working size. `colour` is a video's frame, or the small colour image (H, W, 3) of a file that
    was scanned in colour.
    """

    check: ImageCheck
    gray: Gray
    colour: av.VideoFrame | NDArray[np.uint8] | None = None


# Frames whose images are sound, in order, with their images (H, W) scaled down to the long side.
LoadGray = Callable[[Sequence[RawFrame], int], Iterator[tuple[RawFrame, Gray]]]


def scan_images(
    frames: Sequence[RawFrame], roots: Sequence[Path], limits: Limits, in_colour: Container[int] = ()
) -> Iterator[ImageScan | str]:
    """For each frame, in order: the scan of its image, or why it can't be used.

    Files are decoded on all cores and a video in one go, so that memory holds a few images at once. Files must lie in
    one of `roots`; those at the places `in_colour` are decoded in colour.
    """
    if any(isinstance(frame.image, VideoFrame) for frame in frames):
        return _scan_video(frames, limits)
    placed = ((frame, place in in_colour) for place, frame in enumerate(frames))
    return in_parallel(lambda item: _scan_file(*item, roots, limits), placed)


def read_image(path: Path, roots: Sequence[Path], limits: Limits) -> bytes:
    """An image file's bytes; BadImage for one that is no ordinary file, leads out of `roots`, or is too large."""
    try:
        resolved = path.resolve()
        if not any(resolved.is_relative_to(root) for root in roots):
            raise BadImage("image is a link that leads out of the capture folder")
        status = resolved.stat()
        if not stat.S_ISREG(status.st_mode):
            raise BadImage("image is no ordinary file")
        if status.st_size > limits.max_megapixels * 1e6 * _BYTES_A_PIXEL + _HEADER_BYTES:
            raise BadImage(f"image file of {status.st_size} bytes is too large")
        return resolved.read_bytes()
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links
        inside = next((path.relative_to(root) for root in roots if path.is_relative_to(root)), path)
        raise BadImage(f"image {inside} can't be read: {getattr(error, 'strerror', None) or error}") from None


def load_gray(
    frames: Sequence[RawFrame], long_side: int, roots: Sequence[Path], limits: Limits
) -> Iterator[tuple[RawFrame, Gray]]:
    """Frames that have passed the scan, in order, with their images (H, W) scaled down to the long side. A damaged
    video may not give a frame again."""
    of_video = {frame.image.index: frame for frame in frames if isinstance(frame.image, VideoFrame)}
    if of_video:
        path = next(frame.image.path for frame in frames if isinstance(frame.image, VideoFrame))
        for index, decoded in decode(path, set(of_video), limits):
            yield of_video[index], gray_pixels(decoded, long_side)
        return
    files = [(frame, frame.image.path) for frame in frames if isinstance(frame.image, ImageFile)]
    yield from in_parallel(lambda file: (file[0], decode_gray(read_image(file[1], roots, limits), long_side)), files)


def _scan_file(frame: RawFrame, in_colour: bool, roots: Sequence[Path], limits: Limits) -> ImageScan | str:
    assert isinstance(frame.image, ImageFile)  # a recording has files or a video, never both
    try:
        return ImageScan(*check_image(read_image(frame.image.path, roots, limits), limits.max_megapixels, in_colour))
    except BadImage as error:
        return str(error)


def _scan_video(frames: Sequence[RawFrame], limits: Limits) -> Iterator[ImageScan | str]:
    refs = [frame.image for frame in frames if isinstance(frame.image, VideoFrame)]
    assert len(refs) == len(frames) and len({ref.path for ref in refs}) == 1  # one video a recording
    images = decode(refs[0].path, {ref.index for ref in refs}, limits)
    at, scan = -1, None
    for ref in refs:
        while at < ref.index and (decoded := next(images, None)) is not None:
            at, image = decoded
            gray = gray_pixels(image, WORKING_LONG_SIDE)
            # A frame has no file to hash until it's written.
            scan = ImageScan(ImageCheck.of(gray, image.width, image.height, sha256="", content_sha256=""), gray, image)
        if scan is not None and at == ref.index:
            yield scan
        else:
            yield "video frame is missing or out of order" if at > ref.index else "video ends before this frame"
