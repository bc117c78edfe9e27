"""Video as a source of images: times without decoding, frames one by one in the order of display."""

from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from fractions import Fraction
from itertools import repeat
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Limits, RawFrame, VideoFrame
from groundwalk.capture_import.media import hdr
from groundwalk.store import UserError

# Pixel formats whose first plane is the brightness, a byte a pixel or the lower 10 bits of two.
_BRIGHTNESS_FIRST = {f"yuv{kind}p" for kind in ("420", "422", "444", "j420", "j422", "j444")} | {"nv12", "nv21", "gray"}
_BRIGHTNESS_FIRST_10 = {f"yuv{kind}p10le" for kind in ("420", "422", "444")}
_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm")


def frame_times(path: Path, limits: Limits) -> NDArray[np.int64]:
    """Presentation times (N,) in nanoseconds of a video's frames, in the order of display, without decoding them.

    UserError where the file is no video, holds no frame, or its frames are larger than the limit.
    """
    with _opened(path, limits) as (container, stream):
        ticks_ns = _base(stream) * 1_000_000_000
        times = sorted(tick for packet in container.demux(stream) if (tick := _shown(packet)) is not None)
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
        frame = next(_decoded(container, stream, repeat(True), frozenset()), None)
    if frame is None:
        raise UserError("a video holds no frame", where=path)
    # Displays turn anticlockwise by the angle of the container's matrix.
    quarters = round(-frame.rotation / 90) % 4
    return frame, quarters, frame.color_trc in (hdr.PQ, hdr.HLG)


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
    caller notices which are missing. Only what these frames are made from is decoded.
    """
    try:
        with _opened(path, limits) as (container, stream):
            packets = [(_shown(packet), packet.is_keyframe) for packet in container.demux(stream)]
        times = sorted(tick for tick, _ in packets if tick is not None)
        index_of: dict[int | None, int] = {times[index]: index for index in indices if 0 <= index < len(times)}
        needed = _needed(packets, index_of.keys()).tolist()
        with _opened(path, limits) as (container, stream):
            stream.thread_type = "AUTO"
            for frame in _decoded(container, stream, needed, index_of.keys()):
                if frame.pts in index_of:
                    yield index_of[frame.pts], frame
    except UserError:
        return


def gray_pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """A frame's brightness (H, W), in the frame's own memory, which the decoder uses again."""
    is_10_bit = frame.format.name in _BRIGHTNESS_FIRST_10
    if not is_10_bit and frame.format.name not in _BRIGHTNESS_FIRST:
        return np.asarray(frame.to_ndarray(format="gray"), np.uint8)
    plane, dtype = frame.planes[0], np.dtype("<u2" if is_10_bit else "u1")
    rows = np.frombuffer(plane, dtype).reshape(-1, plane.line_size // dtype.itemsize)  # type: ignore[call-overload]
    pixels = rows[: frame.height, : frame.width]
    return cv2.convertScaleAbs(pixels, alpha=1 / 4) if is_10_bit else pixels


def rgb_pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """A frame (H, W, 3); of HDR, as SDR shows it."""
    if frame.color_trc in (hdr.PQ, hdr.HLG):
        return hdr.sdr_pixels(np.asarray(frame.to_ndarray(format="gbrp10le"), np.uint16), frame.color_trc)
    return np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)


def _shown(packet: av.Packet) -> int | None:
    """When the frame of a packet is shown, in units of the stream's time base; None for one that isn't."""
    return packet.pts if packet.size and not packet.is_discard else None


def _needed(packets: Sequence[tuple[int | None, bool]], ticks: Set[int | None]) -> NDArray[np.bool_]:
    """Which packets (when their frame is shown, whether it's a key frame), in the order of the file, the frames shown
    at these `ticks` are made from: each of all from the last key frame that is shown no later."""
    needed = np.zeros(len(packets), dtype=np.bool_)
    keys = list[tuple[int, int]]()
    for place, (tick, is_key) in enumerate(packets):
        if is_key and tick is not None:
            keys.append((place, tick))
        if tick is not None and tick in ticks:
            start = next((at for at, key_tick in reversed(keys) if key_tick <= tick), 0)
            needed[start : place + 1] = True
    return needed


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream, needed: Iterable[bool], ticks: Set[int | None]
) -> Iterator[av.VideoFrame]:
    """The frames of the `needed` packets, without some that nothing is made from and that aren't shown at `ticks`, and
    without those from a damaged packet to the next key frame."""
    context, was_used, is_damaged = stream.codec_context, False, False
    for packet, is_needed in zip(container.demux(stream), needed, strict=False):
        is_damaged = is_damaged and not packet.is_keyframe
        is_used = is_needed and not is_damaged
        if context.name == "h264":
            # Of HEVC, this would also drop what frames of a higher temporal layer are made from.
            context.skip_frame = "DEFAULT" if packet.pts in ticks else "NONREF"
        try:
            # Without a packet, the decoder gives the frames that it still holds.
            yield from stream.decode(packet if is_used else None) if is_used or was_used else ()
        except av.InvalidDataError:
            is_used, is_damaged = False, True
        if not is_used and (was_used or is_damaged):
            context.flush_buffers()
        was_used = is_used


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
        found = f"{error.strerror}; {path.stat().st_size if path.is_file() else 'no'} bytes"
        raise UserError("a video can't be read", where=path, found=found, do="export the recording again") from None
