"""Do image times and pose times run on the same clock? A constant offset shows where the phone turns."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from capture_import.capture import Limits
from capture_import.intake import Image, Session
from capture_import.scan import load_gray
from geometry.poses import Array, interpolate, relative

_LONG_SIDE = 192
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


def check_clock(session: Session, roots: Sequence[Path], limits: Limits) -> ClockCheck:
    """Find the constant offset at which the rotation of the poses best explains the motion of the images."""
    images = _dense_stretch(session.images)
    if len(images) < _FEWEST_IMAGES:
        return ClockCheck(None, np.nan)
    t_ns = np.array([image.frame.t_ns for image in images], dtype=np.int64)
    times, poses = session.t_ns, session.poses
    # Offsets for which all images lie within the poses.
    reach = np.arange(-_WIDEST_S, _WIDEST_S + _STEP_S / 2, _STEP_S)
    inside = (t_ns[0] + reach * 1e9 >= times[0]) & (t_ns[-1] + reach * 1e9 <= times[-1])
    offsets = reach[inside]
    if len(offsets) < 3:
        return ClockCheck(None, np.nan)
    seen = _image_motion(images, roots, limits)
    scores = np.array([_correlation(seen, _turn(times, poses, t_ns + round(s * 1e9))) for s in offsets])
    best = int(np.argmax(scores))
    clear = scores[best] > _CLEAR and 0 < best < len(offsets) - 1
    return ClockCheck(float(offsets[best]) if clear else None, float(scores[best]))


def _dense_stretch(images: Sequence[Image]) -> Sequence[Image]:
    """The middle part of the longest stretch of images without a long interval."""
    t_s = np.array([image.frame.t_ns for image in images]) * 1e-9
    breaks = [0, *(np.flatnonzero(np.diff(t_s) > _LONGEST_INTERVAL_S) + 1), len(images)]
    longest = int(np.argmax(np.diff(breaks)))
    start, stop = breaks[longest], breaks[longest + 1]
    spare = max(0, stop - start - _MOST_IMAGES) // 2
    return images[start + spare : stop - spare]


def _image_motion(images: Sequence[Image], roots: Sequence[Path], limits: Limits) -> Array:
    """Motion of the image centre from image to image, in focal lengths (N - 1, 2)."""
    shifts = []
    last: NDArray[np.float32] | None = None
    grays = load_gray([image.frame.image for image in images], _LONG_SIDE, roots, limits)
    for image, gray in zip(images, grays, strict=True):
        current = gray.astype(np.float32)
        camera = image.frame.intrinsics
        assert camera is not None  # intake keeps images with intrinsics
        scale = gray.shape[1] / image.check.width
        if last is not None and last.shape == current.shape:
            window = cv2.createHanningWindow((current.shape[1], current.shape[0]), cv2.CV_32F)
            (dx, dy), _ = cv2.phaseCorrelate(last, current, window)
            shifts.append((dx / (camera.fx * scale), dy / (camera.fy * scale)))
        last = current
    return np.array(shifts)


def _turn(times: NDArray[np.int64], poses: Array, at_ns: NDArray[np.int64]) -> Array:
    """Motion of the image centre by rotation alone, in focal lengths (N - 1, 2)."""
    at = interpolate(times, poses, at_ns)
    axis = relative(at[1:], at[:-1])[:, :3, 2]
    centre: Array = axis[:, :2] / axis[:, 2:]
    return centre


def _correlation(a: Array, b: Array) -> float:
    if a.shape != b.shape or not a.std() or not b.std():
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])
