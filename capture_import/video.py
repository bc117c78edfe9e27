"""Video as a source of images: times without decoding, frames one by one in the order of display."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from artefacts import UserError
from capture_import.capture import Limits


def frame_times(path: Path, limits: Limits) -> NDArray[np.int64]:
    """Presentation times (N,) in nanoseconds of a video's frames, in the order of display, without decoding them.

    UserError where the file is no video, holds no frame, or its frames are larger than the limit.
    """
    try:
        with av.open(path) as container:
            stream = _stream(container, path, limits)
            base = stream.time_base or Fraction(1, 1)
            times = [p.pts for p in container.demux(stream) if p.size and p.pts is not None]
    except (av.FFmpegError, OSError) as error:
        raise _unreadable(path, error) from None
    if not times:
        raise UserError("a video holds no frame", where=path)
    ticks_ns = base * 1_000_000_000
    return np.array([round(t * ticks_ns) for t in sorted(times)], dtype=np.int64)


def decode(path: Path, wanted: set[int], limits: Limits, gray: bool) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """The wanted frames of a video as (index, image): (H, W) where gray, else (H, W, 3) in RGB.

    A damaged video ends early; the caller notices which frames it didn't get.
    """
    last = max(wanted, default=-1)
    try:
        with av.open(path) as container:
            stream = _stream(container, path, limits)
            stream.thread_type = "AUTO"
            for index, frame in enumerate(container.decode(stream)):
                if index in wanted:
                    yield index, np.asarray(frame.to_ndarray(format="gray" if gray else "rgb24"), np.uint8)
                if index >= last:
                    return
    except (av.FFmpegError, OSError):
        return


def _stream(container: av.container.InputContainer, path: Path, limits: Limits) -> av.VideoStream:
    if not container.streams.video:
        raise UserError("a file holds no video", where=path, found="no video stream")
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise UserError("a video's codec is unknown", where=path, do="export the recording as H.264 or HEVC")
    if stream.width * stream.height > limits.max_megapixels * 1e6:
        raise UserError(
            f"a video's frames are larger than {limits.max_megapixels:g} megapixels",
            where=path,
            found=f"{stream.width}x{stream.height}",
        )
    return stream


def _unreadable(path: Path, error: Exception) -> UserError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return UserError("a video can't be read", where=path, found=reason, do="export the recording again")
