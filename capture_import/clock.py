"""Do image times and pose times run on the same clock? A constant offset shows where the phone turns."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import RawFrame
from groundwalk.capture_import.images import Gray
from groundwalk.capture_import.intake import Session
from groundwalk.capture_import.scan import LoadGray
from groundwalk.geometry.poses import Array, interpolate, relative

CLOCK_LONG_SIDE = 192
_MOST_IMAGES = 240
_FEWEST_IMAGES = 20
# Slower images don't show when a turn began.
_LONGEST_INTERVAL_S = 0.15
_WIDEST_S = 0.5
_STEP_S = 0.005
# Motion in the image is rotation for far things only; below this the two don't belong together clearly enough.
_CLEAR = 0.8
# An offset beyond this moves the pose noticeably: at 60 deg/s by 2 degrees.
NOTICEABLE_S = 0.033


@dataclass(frozen=True)
class ClockCheck:
    """`offset_s`: how much later than its stated time an image fits the poses; None where images are too rare, too
    few, or their motion doesn't follow the poses clearly. `correlation` is that of image motion and rotation."""

    offset_s: float | None
    correlation: float


def check_clock(session: Session, load: LoadGray) -> ClockCheck:
    """Find the constant offset at which the rotation of the poses best explains the motion of the images."""
    views = list(load(dense_stretch([image.frame for image in session.images]), CLOCK_LONG_SIDE))
    if len(views) < _FEWEST_IMAGES:
        return ClockCheck(None, np.nan)
    t_ns = np.array([frame.t_ns for frame, _ in views], dtype=np.int64)
    times, poses = session.t_ns, session.poses
    # Offsets for which all images lie within the poses.
    reach = np.arange(-_WIDEST_S, _WIDEST_S + _STEP_S / 2, _STEP_S)
    inside = (t_ns[0] + reach * 1e9 >= times[0]) & (t_ns[-1] + reach * 1e9 <= times[-1])
    offsets = reach[inside]
    if len(offsets) < 3:
        return ClockCheck(None, np.nan)
    width_of = {image.frame.number: image.check.width for image in session.images}
    seen = _image_motion([(frame, gray, gray.shape[1] / width_of[frame.number]) for frame, gray in views])
    at_ns = t_ns + np.round(offsets[:, None] * 1e9).astype(np.int64)
    scores = np.array([_correlation(seen, turn) for turn in _turns(times, poses, at_ns)])
    best = int(np.argmax(scores))
    clear = scores[best] > _CLEAR and 0 < best < len(offsets) - 1
    return ClockCheck(float(offsets[best]) if clear else None, float(scores[best]))


def dense_stretch(frames: Sequence[RawFrame]) -> Sequence[RawFrame]:
    """Of frames with images, the middle part of the longest stretch without a long interval, so far from the first and
    the last frame, where there are enough, that it can be shifted; none where it's too short to tell anything."""
    t_s = np.array([frame.t_ns for frame in frames]) * 1e-9
    breaks = [0, *(np.flatnonzero(np.diff(t_s) > _LONGEST_INTERVAL_S) + 1), len(frames)]
    longest = int(np.argmax(np.diff(breaks)))
    start, stop = breaks[longest], breaks[longest + 1]
    if stop - start < _FEWEST_IMAGES:
        return []
    inner = np.searchsorted(t_s, [t_s[0] + _WIDEST_S, t_s[-1] - _WIDEST_S]).clip(start, stop)
    if inner[1] - inner[0] >= _FEWEST_IMAGES:
        start, stop = int(inner[0]), int(inner[1])
    spare = max(0, stop - start - _MOST_IMAGES) // 2
    return frames[start + spare : stop - spare]


def _image_motion(views: Sequence[tuple[RawFrame, Gray, float]]) -> Array:
    """Motion of the image centre from image to image, in focal lengths (N - 1, 2); each image with its scale."""
    shifts = []
    window = None
    last: NDArray[np.float32] | None = None
    for frame, gray, scale in views:
        current = gray.astype(np.float32)
        camera = frame.intrinsics
        assert camera is not None  # intake keeps images with intrinsics
        if last is not None and last.shape == current.shape:
            if window is None or window.shape != current.shape:
                window = cv2.createHanningWindow((current.shape[1], current.shape[0]), cv2.CV_32F)
            (dx, dy), _ = cv2.phaseCorrelate(last, current, window)
            shifts.append((dx / (camera.fx * scale), dy / (camera.fy * scale)))
        last = current
    return np.array(shifts)


def _turns(times: NDArray[np.int64], poses: Array, at_ns: NDArray[np.int64]) -> Array:
    """Motion of the image centre by rotation alone from time to time (K, N), in focal lengths (K, N - 1, 2)."""
    at = interpolate(times, poses, at_ns.ravel()).reshape(*at_ns.shape, 4, 4)
    axis = relative(at[:, 1:], at[:, :-1])[..., :3, 2]
    centres: Array = axis[..., :2] / axis[..., 2:]
    return centres


def _correlation(a: Array, b: Array) -> float:
    if a.shape != b.shape or not a.std() or not b.std():
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])
