"""Video as a source of images: times without decoding, frames one by one in the order of display."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Limits, RawFrame, VideoFrame
from groundwalk.store import UserError

# Pixel formats whose first plane is the brightness, a byte a pixel.
_BRIGHTNESS_FIRST = {f"yuv{j}{chroma}p" for j in ("", "j") for chroma in (420, 422, 444)} | {"nv12", "nv21", "gray"}
_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm")
# Perceptual quantiser and hybrid log-gamma (ITU-R BT.2100), by their numbers in ITU-T H.273.
_HDR_TRANSFERS = (16, 18)
# Phones write a key frame every second or so: seeking over less decodes the same frames again.
_MIN_GAP_S = 3.0


def frame_times(path: Path, limits: Limits) -> NDArray[np.int64]:
    """Presentation times (N,) in nanoseconds of a video's frames, in the order of display, without decoding them.

    UserError where the file is no video, holds no frame, or its frames are larger than the limit.
    """
    with _opened(path, limits) as (container, stream):
        ticks_ns = _base(stream) * 1_000_000_000
        times = _ticks(container, stream)
    if not times:
        raise UserError("a video holds no frame", where=path)
    return np.array([round(t * ticks_ns) for t in times], dtype=np.int64)


def is_video(path: Path) -> bool:
    """Whether a file's name is that of a video."""
    return path.suffix.lower() in _SUFFIXES and path.is_file()


def first_frame(path: Path, limits: Limits) -> tuple[av.VideoFrame, int, bool]:
    """A video's first frame, the quarter turns clockwise that show it upright, and whether its brightness is coded for
    HDR; UserError where it has none."""
    with _opened(path, limits) as (container, stream):
        frame = next(container.decode(stream), None)
    if frame is None:
        raise UserError("a video holds no frame", where=path)
    # Displays turn anticlockwise by the angle of the container's matrix.
    quarters = round(-frame.rotation / 90) % 4
    return frame, quarters, frame.color_trc in _HDR_TRANSFERS


def check_join(path: Path, log: str, frames: Sequence[RawFrame], rows: int, limits: Limits) -> list[str]:
    """A note where a video hasn't as many frames as its log has rows, to which they belong by number; `frames` are the
    rows that can be read. UserError where more than the end is missing: their clocks then don't run together."""
    video_ns = frame_times(path, limits)
    if rows == len(video_ns) or not frames:
        return []
    refs = [(frame.t_ns, frame.image.index) for frame in frames if isinstance(frame.image, VideoFrame)]
    off_ns = np.array([t_ns - video_ns[index] for t_ns, index in refs if 0 <= index < len(video_ns)], dtype=np.int64)
    interval = float(np.median(np.diff(video_ns))) if len(video_ns) > 1 else 0.0
    apart = np.abs(off_ns - off_ns[0]).max() if len(off_ns) else np.inf
    if apart > interval / 2:
        raise UserError(
            f"the video's frames can't be joined to the rows of {log}",
            where=path,
            expected="as many frames as rows",
            found=f"{len(video_ns)} frames, {rows} rows, clocks apart by up to {apart * 1e-9:.3f} s",
            do="export the recording again",
        )
    return [f"{len(video_ns)} video frames for {rows} rows: the end without a partner is left out"]


def decode(path: Path, indices: set[int], limits: Limits) -> Iterator[tuple[int, av.VideoFrame]]:
    """The frames of a video with these `indices` in the order of display, each with its index.

    A frame is identified by its time, so that frames which a damaged file has lost don't shift those after them; the
    caller notices which are missing. Long parts without such a frame are skipped.
    """
    try:
        with _opened(path, limits) as (container, stream):
            second = round(1 / _base(stream))
            ticks = _ticks(container, stream)
        index_of: dict[int | None, int] = {tick: index for index, tick in enumerate(ticks)}
        wanted = np.array([[i, ticks[i]] for i in sorted(indices) if 0 <= i < len(ticks)], dtype=np.int64).reshape(
            -1, 2
        )
        # Cut at gaps so long that seeking is cheaper than decoding.
        runs = np.split(wanted[:, 0], np.flatnonzero(np.diff(wanted[:, 1]) > _MIN_GAP_S * second) + 1)
        with _opened(path, limits) as (container, stream):
            stream.thread_type = "AUTO"
            for first, last in ((int(run[0]), int(run[-1])) for run in runs if len(run)):
                # Containers seek by the time of decoding: the key frame may be shown after the first frame.
                for back in (0, second):
                    if ticks[first] - second > ticks[0]:
                        container.seek(ticks[first] - back, stream=stream)
                    frames = ((index_of.get(frame.pts, -1), frame) for frame in container.decode(stream))
                    start = next(frames, None)
                    if start is None or start[0] <= first:
                        break
                for index, frame in chain([start] if start else [], frames):
                    if index in indices and index >= first:
                        yield index, frame
                    if index >= last:
                        break
    except UserError:
        return


def gray_pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """A frame's brightness (H, W), in the frame's own memory, which the decoder uses again."""
    if frame.format.name not in _BRIGHTNESS_FIRST:
        return np.asarray(frame.to_ndarray(format="gray"), np.uint8)
    plane = frame.planes[0]
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)  # type: ignore[call-overload]
    return rows[: frame.height, : frame.width]


def rgb_pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """A frame (H, W, 3)."""
    return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)


def _ticks(container: av.container.InputContainer, stream: av.VideoStream) -> list[int]:
    """Presentation times of the frames that the container shows, rising, in units of the stream's time base."""
    return sorted(p.pts for p in container.demux(stream) if p.size and p.pts is not None and not p.is_discard)


def _base(stream: av.VideoStream) -> Fraction:
    return stream.time_base or Fraction(1, 1)


@contextmanager
def _opened(path: Path, limits: Limits) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """A video's container and its first stream of images; UserError where it can't be read, or is too large."""
    try:
        with av.open(path) as container:
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
            yield container, stream
    except (av.FFmpegError, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise UserError("a video can't be read", where=path, found=reason, do="export the recording again") from None
