"""Which of a session's sound images are kept."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geometry.poses import Array, relative, rotation_angle

Sampling = Literal["rate", "motion", "all"]

# Around each tick of the rate the sharpest image within this share of the interval is taken: a wider window would find
# sharper ones, but steps between frames would no longer be near the interval.
_WINDOW = 0.25


def sample_rate(t_ns: NDArray[np.int64], sharpness: Array, rate_hz: float) -> NDArray[np.int64]:
    """Indices of one image an interval of 1/rate_hz: the sharpest within a quarter of the interval on either side of
    the tick, or else the nearest within half of it. Ticks without an image in reach are left out."""
    return _sharpest(rate_candidates(t_ns, rate_hz), sharpness)


def sample_motion(poses: Array, sharpness: Array, step_m: float, step_deg: float) -> NDArray[np.int64]:
    """Indices of the sharpest image in each stretch of the walk that moves less than step_m and turns less than
    step_deg from its first image."""
    return _sharpest(motion_candidates(poses, step_m, step_deg), sharpness)


def rate_candidates(t_ns: NDArray[np.int64], rate_hz: float) -> list[NDArray[np.int64]]:
    """For each tick of the rate, the indices of the images from which `sample_rate` takes the sharpest."""
    interval = 1e9 / rate_hz
    since = (t_ns - t_ns[0]).astype(float) / interval
    tick = np.floor(since + 0.5)
    off = np.abs(since - tick)
    found = []
    for group in np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(tick)) + 1):
        near = group[off[group] <= _WINDOW]
        found.append(near if len(near) else group[[np.argmin(off[group])]])
    return found


def motion_candidates(poses: Array, step_m: float, step_deg: float) -> list[NDArray[np.int64]]:
    """For each stretch of the walk, the indices of the images from which `sample_motion` takes the sharpest."""
    starts = [0]
    for i in range(1, len(poses)):
        step = relative(poses[starts[-1]], poses[i])
        if np.linalg.norm(step[:3, 3]) >= step_m or np.degrees(rotation_angle(step[:3, :3])) >= step_deg:
            starts.append(i)
    return np.split(np.arange(len(poses)), starts[1:])


def _sharpest(candidates: list[NDArray[np.int64]], sharpness: Array) -> NDArray[np.int64]:
    return np.array([group[np.argmax(sharpness[group])] for group in candidates], dtype=np.int64)
