"""Reading the images of a recording, files or frames of a video: sound or not, size and sharpness, and in grey."""

import math
import stat
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import av
import cv2
import numpy as np

from groundwalk.capture_import.capture import ImageCheck, ImageFile, Limits, RawFrame, VideoFrame
from groundwalk.capture_import.media.images import (
    WORKING_LONG_SIDE,
    BadImage,
    Gray,
    check_image,
    decode_gray,
    decode_rgb,
    measured,
    shrunk,
    turned_pixels,
)
from groundwalk.capture_import.media.video import decode, gray_pixels, rgb_pixels
from groundwalk.store.parallel import in_parallel

Frame = TypeVar("Frame", bound=RawFrame)

# A sound JPEG or PNG has fewer bytes than this a pixel, and a header with metadata.
_BYTES_A_PIXEL = 4
_HEADER_BYTES = 1 << 20
# Grey levels, of 255: a walk changes by up to 10 from image to image, and by 2 more than before; images of two places
# differ by 27 and more. Several are looked at, as some videos show each image twice.
_CUT_CHANGE, _CUT_IMAGES = 15.0, 6


@dataclass(frozen=True)
class ImageReader:
    """Reads images within limits; files must lie in one of `roots`."""

    roots: Sequence[Path]
    limits: Limits

    def check(self, frames: Sequence[RawFrame]) -> Iterator[ImageCheck | str]:
        """For each frame, in order: what was measured of its image, or why it can't be used. Files are decoded on all
        cores and a video in one go, so that memory holds a few images at once."""
        return self._check_video(frames) if video_of(frames) else in_parallel(self._check_file, frames)

    def gray(self, frames: Sequence[Frame], long_side: int) -> Iterator[tuple[Frame, Gray]]:
        """Frames that have passed the check, in order, each with its image (H, W) scaled down to the long side. A
        damaged video may not give a frame again."""
        return self._pictures(frames, long_side, _working_gray, decode_gray)

    def rgb(self, frames: Sequence[Frame], long_side: int) -> Iterator[tuple[Frame, Gray]]:
        """As `gray`, in colour (H, W, 3)."""
        return self._pictures(frames, long_side, rgb_pixels, lambda data: decode_rgb(data, long_side))

    def _pictures(
        self,
        frames: Sequence[Frame],
        long_side: int,
        of_video: Callable[[av.VideoFrame], Gray],
        of_file: Callable[[bytes], Gray],
    ) -> Iterator[tuple[Frame, Gray]]:
        pictures: Iterator[tuple[Frame, Gray]]
        if video := video_of(frames):
            of_index = {frame.image.index: frame for frame in frames if isinstance(frame.image, VideoFrame)}
            decoded = decode(video, set(of_index), self.limits)
            pictures = ((of_index[index], of_video(picture)) for index, picture in decoded)
        else:
            pictures = in_parallel(lambda frame: (frame, of_file(self._bytes(frame))), frames)
        for frame, picture in pictures:
            yield frame, turned_pixels(shrunk(picture, long_side), frame.quarters)

    def read(self, path: Path, max_bytes: float = math.inf) -> bytes:
        """A file's bytes; BadImage for one that is no ordinary file, leads out of `roots`, or is too large."""
        max_bytes = min(max_bytes, self.limits.max_megapixels * 1e6 * _BYTES_A_PIXEL + _HEADER_BYTES)
        try:
            resolved = path.resolve()
            if not any(resolved.is_relative_to(root) for root in self.roots):
                raise BadImage("is a link that leads out of the capture folder")
            status = resolved.stat()
            if not stat.S_ISREG(status.st_mode):
                raise BadImage("is no ordinary file")
            if status.st_size > max_bytes:
                raise BadImage(f"file of {status.st_size} bytes is too large")
            return resolved.read_bytes()
        except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links
            inside = next((path.relative_to(root) for root in self.roots if path.is_relative_to(root)), path)
            raise BadImage(f"{inside} can't be read: {getattr(error, 'strerror', None) or error}") from None

    def _bytes(self, frame: RawFrame) -> bytes:
        assert isinstance(frame.image, ImageFile)  # a recording has files or a video, never both
        return self.read(frame.image.path)

    def _check_file(self, frame: RawFrame) -> ImageCheck | str:
        try:
            return _turned(check_image(self._bytes(frame), self.limits.max_megapixels), frame.quarters)
        except BadImage as error:
            return f"image {error}"

    def _check_video(self, frames: Sequence[RawFrame]) -> Iterator[ImageCheck | str]:
        refs = [frame.image for frame in frames if isinstance(frame.image, VideoFrame)]
        assert len(refs) == len(frames) and len({ref.path for ref in refs}) == 1  # one video a recording
        images = decode(refs[0].path, {ref.index for ref in refs}, self.limits)
        at, check, part = -1, None, 0
        before, changes = None, deque[float](maxlen=_CUT_IMAGES)
        for ref in refs:
            while at < ref.index and (decoded := next(images, None)) is not None:
                at, image = decoded
                gray = _working_gray(image)
                if before is not None and before.shape == gray.shape:
                    # A pan or a shaking hand changes much in each image, a cut in one (as in FFmpeg's scdet); what all
                    # pixels have in common, as when a lamp is turned on, is no change.
                    difference = cv2.subtract(gray, before, dtype=cv2.CV_32F)
                    changes.append(float(np.abs(difference - difference.mean()).mean()))
                    part += len(changes) == _CUT_IMAGES and changes[-1] > max(list(changes)[:-1]) + _CUT_CHANGE
                before = gray
                # A frame has no file to hash until it's written.
                check = replace(_turned(measured(gray, image.width, image.height), frames[0].quarters), part=part)
            if check is not None and at == ref.index:
                yield check
            else:
                yield "video frame is missing or out of order" if at > ref.index else "video ends before this frame"


def video_of(frames: Iterable[RawFrame]) -> Path | None:
    """The video that frames are of; None where their images are files."""
    return next((frame.image.path for frame in frames if isinstance(frame.image, VideoFrame)), None)


def _turned(check: ImageCheck, quarters: int) -> ImageCheck:
    """What was measured of an image, after quarter turns."""
    return replace(check, width=check.height, height=check.width) if quarters % 2 else check


def _working_gray(frame: av.VideoFrame) -> Gray:
    """A copy of a video frame's brightness (H, W) in the working size."""
    return np.array(shrunk(gray_pixels(frame), WORKING_LONG_SIDE), np.uint8)
