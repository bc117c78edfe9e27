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
    interval = 1e9 / rate_hz
    since = (t_ns - t_ns[0]).astype(float) / interval
    tick = np.floor(since + 0.5)
    off = np.abs(since - tick)
    kept = []
    for group in np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(tick)) + 1):
        near = group[off[group] <= _WINDOW]
        kept.append(near[np.argmax(sharpness[near])] if len(near) else group[np.argmin(off[group])])
    return np.array(kept, dtype=np.int64)


def sample_motion(poses: Array, sharpness: Array, step_m: float, step_deg: float) -> NDArray[np.int64]:
    """Indices of the sharpest image in each stretch of the walk that moves less than step_m and turns less than
    step_deg from its first image."""
    starts = [0]
    for i in range(1, len(poses)):
        step = relative(poses[starts[-1]], poses[i])
        if np.linalg.norm(step[:3, 3]) >= step_m or np.degrees(rotation_angle(step[:3, :3])) >= step_deg:
            starts.append(i)
    stretches = np.split(np.arange(len(poses)), starts[1:])
    return np.array([s[np.argmax(sharpness[s])] for s in stretches], dtype=np.int64)
