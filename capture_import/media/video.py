"""Video as a source of images: times without decoding, frames one by one in the order of display, HDR as SDR.

HDR's transfer functions are those of ITU-R BT.2100, the tone curve BT.2390's, the primaries BT.2087's. HLG is shown on
a display of 1,000 cd/m2, where light ends, and SDR's white is HDR's reference white of 203 cd/m2 (BT.2408).
"""

import functools
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from fractions import Fraction
from itertools import repeat
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Limits, RawFrame, VideoFrame
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError

# Pixel formats whose first plane is the brightness, a byte a pixel or the lower 10 bits of two.
_BRIGHTNESS_FIRST = {f"yuv{kind}p" for kind in ("420", "422", "444", "j420", "j422", "j444")} | {"nv12", "nv21", "gray"}
_BRIGHTNESS_FIRST_10 = {f"yuv{kind}p10le" for kind in ("420", "422", "444")}
_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm")
# Perceptual quantiser and hybrid log-gamma, by their numbers in ITU-T H.273.
PQ, HLG = 16, 18
_WHITE_NITS, _PEAK_NITS = 203.0, 1000.0
_LUMINANCE = np.array([[0.2627, 0.6780, 0.0593]])
_BT2020_TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
_HLG_GAMMA = 1.2
# Steps of tables over the root of light, in which dark colours are as fine as they look.
_STEPS = 1 << 16
_ROWS = 16


def frame_times(path: Path, limits: Limits) -> NDArray[np.int64]:
    """Presentation times (N,) in nanoseconds of a video's frames, in the order of display, without decoding them.

    UserError where the file is no video, holds no frame, or its frames are larger than the limit.
    """
    with _opened(path, limits) as (container, stream):
        ticks_ns = (stream.time_base or Fraction(1, 1)) * 1_000_000_000
        times = sorted(tick for packet in container.demux(stream) if (tick := _shown(packet)) is not None)
    if not times:
        raise UserError("a video holds no frame", where=path)
    return np.array([round(t * ticks_ns) for t in times], dtype=np.int64)


def is_video(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and path.is_file()


def first_frame(path: Path, limits: Limits) -> tuple[av.VideoFrame, int, bool]:
    """A video's first frame, the quarter turns clockwise that show it upright, and whether its brightness is coded for
    HDR; UserError where it has none."""
    with _opened(path, limits) as (container, stream):
        frame = next(_decoded(container, stream, repeat(True), frozenset()), None)
    if frame is None:
        raise UserError("a video holds no frame", where=path)
    # Displays turn anticlockwise by the angle of the container's matrix.
    quarters = round(-frame.rotation / 90) % 4
    return frame, quarters, frame.color_trc in (PQ, HLG)


def check_join(path: Path, video_ns: NDArray[np.int64], log: str, frames: Sequence[RawFrame], rows: int) -> list[str]:
    """A note where a video, with frames at the times `video_ns`, hasn't as many as its log has rows, to which they
    belong by number; `frames` are the rows that can be read. UserError where more than the end is missing: their clocks
    then don't run together."""
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
    if frame.color_trc in (PQ, HLG):
        return sdr_pixels(np.asarray(frame.to_ndarray(format="gbrp10le"), np.uint16), frame.color_trc)
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


def sdr_pixels(rgb: NDArray[np.uint16], transfer: int) -> NDArray[np.uint8]:
    """An image (H, W, 3) in sRGB of one in BT.2100's colours, 10 bits each. Up to 0.43 of the reference white colours
    stay as they are; brighter ones keep their hue."""
    sdr, light_of, (gain_of, srgb_of) = np.empty(rgb.shape, np.uint8), _light_of(transfer), _tone_tables()
    # Few rows at once stay in the processor's cache.
    for top in range(0, len(rgb), _ROWS):
        light: Any = np.take(light_of, rgb[top : top + _ROWS], mode="clip")
        if transfer == HLG:
            # What is displayed grows faster than what was seen, by its luminance.
            shown = cv2.pow(cv2.transform(light, _LUMINANCE), _HLG_GAMMA - 1)
            light = cv2.multiply(light, cv2.merge([shown] * 3))
        light = np.maximum(cv2.transform(light, _BT2020_TO_BT709), 0)
        red, green, blue = cv2.split(light)
        gain = np.take(gain_of, _step(cv2.max(cv2.max(red, green), blue)))
        sdr[top : top + _ROWS] = np.take(srgb_of, _step(cv2.multiply(light, cv2.merge([gain] * 3))))
    return sdr


def _step(light: Any) -> NDArray[np.uint16]:
    """Where light, 1 at the peak, is in the tables."""
    return (np.minimum(cv2.sqrt(light), 1) * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.uint16)


def _pq_nits(code: Array) -> Array:
    """PQ's light, cd/m2, of codes from 0 to 1 (BT.2100, table 4)."""
    power = code ** (1 / 78.84375)
    return 10_000.0 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)


def _pq_code(nits: Array) -> Array:
    power = (nits / 10_000.0) ** 0.1593017578125
    return np.asarray((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def _tone_mapped(nits: Array) -> Array:
    """What SDR shows, 0 to 1, of light up to the peak: the curve of BT.2390, section 5.4.1."""
    peak, white = _pq_code(np.array([_PEAK_NITS, _WHITE_NITS]))
    code, most = _pq_code(nits) / peak, white / peak
    knee = 1.5 * most - 0.5
    t = np.maximum(code - knee, 0) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return _pq_nits(np.where(code < knee, code, spline) * peak) / _WHITE_NITS


@functools.cache
def _light_of(transfer: int) -> Any:
    """Light of each code, 1 at the peak: of HLG as it was in front of the camera, of PQ as it is displayed."""
    code = np.arange(1024) / 1023
    if transfer == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073  # BT.2100, table 5
        light = np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)
    else:
        light = np.minimum(_pq_nits(code) / _PEAK_NITS, 1)
    return light.astype(np.float32)


@functools.cache
def _tone_tables() -> tuple[Any, Any]:
    """By the steps of light (`_step`): what its brightest colour is multiplied by, and sRGB's code."""
    light = np.linspace(0, 1, _STEPS)[1:] ** 2
    gain = np.append(_PEAK_NITS / _WHITE_NITS, _tone_mapped(_PEAK_NITS * light) / light).astype(np.float32)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return gain, np.append(0, np.round(255 * srgb)).astype(np.uint8)
