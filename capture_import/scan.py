"""Looking at every image of a recording: sound or not, how large, how sharp."""

import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from capture_import.capture import ImageFile, ImageRef, Limits, RawFrame, VideoFrame
from capture_import.images import WORKING_LONG_SIDE, BadImage, ImageCheck, check_image, decode_gray, sharpness
from capture_import.parallel import in_parallel
from capture_import.video import decode, gray_pixels

# Called with a video frame's place among the scanned frames, its sharpness, and the frame.
Keep = Callable[[int, float, av.VideoFrame], None]

# A sound JPEG or PNG has fewer bytes than this a pixel, and a header with metadata.
_BYTES_A_PIXEL = 4
_HEADER_BYTES = 1 << 20


def scan_images(
    frames: Sequence[RawFrame], roots: Sequence[Path], limits: Limits, keep: Keep | None = None
) -> Iterator[ImageCheck | str]:
    """For each frame, in order: what its image measures, or why it can't be used.

    Files are decoded on all cores and a video in one go, so that memory holds a few images at once. Files must lie in
    one of `roots`. `keep` is called with each sound video frame.
    """
    if any(isinstance(frame.image, VideoFrame) for frame in frames):
        return _scan_video(frames, limits, keep)
    return in_parallel(lambda frame: _scan_file(frame, roots, limits), frames)


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
        raise BadImage(f"image can't be read: {getattr(error, 'strerror', None) or error}") from None


def load_gray(
    refs: Sequence[ImageRef | None], long_side: int, roots: Sequence[Path], limits: Limits
) -> Iterator[NDArray[np.uint8]]:
    """Images (H, W) that have passed the scan, in order, scaled down to the long side."""
    video = [ref for ref in refs if isinstance(ref, VideoFrame)]
    if video:
        for _, frame in decode(video[0].path, {ref.index for ref in video}, limits):
            yield gray_pixels(frame, long_side)
        return
    files = [ref.path for ref in refs if isinstance(ref, ImageFile)]
    yield from in_parallel(lambda path: decode_gray(read_image(path, roots, limits), long_side), files)


def _scan_file(frame: RawFrame, roots: Sequence[Path], limits: Limits) -> ImageCheck | str:
    assert isinstance(frame.image, ImageFile)  # a recording has files or a video, never both
    try:
        return check_image(read_image(frame.image.path, roots, limits), limits.max_megapixels)
    except BadImage as error:
        return str(error)


def _scan_video(frames: Sequence[RawFrame], limits: Limits, keep: Keep | None) -> Iterator[ImageCheck | str]:
    refs = [frame.image for frame in frames if isinstance(frame.image, VideoFrame)]
    assert len(refs) == len(frames) and len({ref.path for ref in refs}) == 1  # one video a recording
    images = decode(refs[0].path, {ref.index for ref in refs}, limits)
    at, check = -1, None
    for position, ref in enumerate(refs):
        while at < ref.index and (decoded := next(images, None)) is not None:
            at, image = decoded
            # A frame has no file to hash until it's written.
            measured = sharpness(gray_pixels(image, WORKING_LONG_SIDE))
            check = ImageCheck(image.width, image.height, measured, sha256="")
        if check is not None and at == ref.index:
            if keep is not None:
                keep(position, check.sharpness, image)
            yield check
        else:
            yield "video frame is missing or out of order" if at > ref.index else "video ends before this frame"
