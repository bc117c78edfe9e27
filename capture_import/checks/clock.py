"""Do image times and pose times run on the same clock? Turns of the phone show a constant offset."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Session
from groundwalk.capture_import.media.images import Gray
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.geometry.poses import Array, interpolate, relative

_LONG_SIDE = 192
_MAX_IMAGES = 240
_MIN_IMAGES = 20
# Images further apart don't show when a turn began.
_MAX_INTERVAL_S = 0.15
_SEARCH_S = 0.5
_STEP_S = 0.005
# Motion in the image is rotation for far things only; a lower correlation decides nothing.
_MIN_CORRELATION = 0.8
# An offset beyond this moves the pose noticeably: at 60 deg/s by 2 degrees.
MAX_OFFSET_S = 0.033


@dataclass(frozen=True)
class ClockCheck:
    """`offset_s`: how much later than its stated time an image fits the poses; None where images are too rare, too
    few, or their motion doesn't follow the poses clearly. `correlation` is that of image motion and rotation."""

    offset_s: float | None
    correlation: float


def check_clock(session: Session, images: ImageReader) -> ClockCheck:
    """Find the constant offset at which the rotation of the poses best explains the motion of the images."""
    if not session.has_poses:
        return ClockCheck(None, np.nan)
    views = list(images.gray(_dense_part(session.images), _LONG_SIDE))
    if len(views) < _MIN_IMAGES:
        return ClockCheck(None, np.nan)
    t_ns = np.array([frame.t_ns for frame, _ in views], dtype=np.int64)
    times, poses = session.t_ns, session.poses
    # Offsets for which all images lie within the poses.
    reach = np.arange(-_SEARCH_S, _SEARCH_S + _STEP_S / 2, _STEP_S)
    inside = (t_ns[0] + reach * 1e9 >= times[0]) & (t_ns[-1] + reach * 1e9 <= times[-1])
    offsets = reach[inside]
    if len(offsets) < 3:
        return ClockCheck(None, np.nan)
    motion = _image_motion(views)
    # Motion of the image centre by rotation alone, from time to time at each offset, in focal lengths (K, N - 1, 2).
    at_ns = t_ns + np.round(offsets[:, None] * 1e9).astype(np.int64)
    at = interpolate(times, poses, at_ns.ravel()).reshape(*at_ns.shape, 4, 4)
    axis = relative(at[:, 1:], at[:, :-1])[..., :3, 2]
    turns = axis[..., :2] / axis[..., 2:]
    if motion.shape != turns.shape[1:] or not motion.std():
        return ClockCheck(None, 0.0)
    scores = np.array([np.corrcoef(motion.ravel(), turn.ravel())[0, 1] if turn.std() else 0.0 for turn in turns])
    best = int(np.argmax(scores))
    is_clear = scores[best] > _MIN_CORRELATION and 0 < best < len(offsets) - 1
    return ClockCheck(float(offsets[best]) if is_clear else None, float(scores[best]))


def _dense_part(frames: Sequence[Image]) -> Sequence[Image]:
    """Of frames with images, the middle of the longest part without a long interval, so far from the first and the last
    frame, where there are enough, that it can be shifted; none where it's too short."""
    t_s = np.array([frame.t_ns for frame in frames]) * 1e-9
    breaks = [0, *(np.flatnonzero(np.diff(t_s) > _MAX_INTERVAL_S) + 1), len(frames)]
    longest = int(np.argmax(np.diff(breaks)))
    start, stop = breaks[longest], breaks[longest + 1]
    if stop - start < _MIN_IMAGES:
        return []
    inner = np.searchsorted(t_s, [t_s[0] + _SEARCH_S, t_s[-1] - _SEARCH_S]).clip(start, stop)
    if inner[1] - inner[0] >= _MIN_IMAGES:
        start, stop = int(inner[0]), int(inner[1])
    spare = max(0, stop - start - _MAX_IMAGES) // 2
    return frames[start + spare : stop - spare]


def _image_motion(views: Sequence[tuple[Image, Gray]]) -> Array:
    """Motion of the image centre from image to image, in focal lengths (N - 1, 2)."""
    shifts = []
    last: NDArray[np.float32] | None = None
    for image, gray in views:
        height, width = gray.shape
        # phaseCorrelate would write its window into its images, into each one twice.
        current = gray * cv2.createHanningWindow((width, height), cv2.CV_32F)
        if last is not None and last.shape == current.shape:
            (dx, dy), _ = cv2.phaseCorrelate(last, current)
            scale = width / image.check.width
            shifts.append((dx / (image.camera.fx * scale), dy / (image.camera.fy * scale)))
        last = current
    return np.array(shifts)
