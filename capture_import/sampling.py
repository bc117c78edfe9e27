"""Which of a session's sound images become frames of the dataset, and which support them in SfM."""

import heapq
import math
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geometry.poses import Array, relative, rotation_angle

Sampling = Literal["rate", "motion", "all"]

# Around each tick of the rate the sharpest image within this share of the interval is taken: a wider window would find
# sharper ones, but steps between frames would no longer be near the interval.
_WINDOW = 0.25
# Of images that cut a gap nearly as evenly as the best one, the sharpest is taken: with steps up to this much larger.
_UNEVEN = 1.25
# Steps of exactly the limit may come out a rounding error larger.
_ROUNDING = 1e-9


def sample_rate(t_ns: NDArray[np.int64], sharpness: Array, rate_hz: float) -> NDArray[np.int64]:
    """Indices of one image an interval of 1/rate_hz: the sharpest within a quarter of the interval on either side of
    the tick, or else the nearest within half of it. Ticks without an image in reach are left out."""
    return _sharpest(rate_candidates(t_ns, rate_hz), sharpness)


def sample_motion(poses: Array, sharpness: Array, step_m: float, step_deg: float) -> NDArray[np.int64]:
    """Indices of the sharpest image in each stretch of the walk that moves less than step_m and turns less than
    step_deg from its first image."""
    return _sharpest(motion_candidates(poses, step_m, step_deg), sharpness)


def sample_support(
    poses: Array, sharpness: Array, kept: NDArray[np.int64], step_m: float, step_deg: float, most: int
) -> NDArray[np.int64]:
    """Indices of images between those kept, so that neighbours are at most step_m and step_deg apart (0: no matter).

    Poses (N, 4, 4) and sharpness (N,) are the session's in order of time, `kept` rises. The largest gap is cut first,
    into even steps and as few as it needs, and of images that do so about as well the sharpest is taken. The limits
    hold wherever there are images to hold them, unless more than `most` would be needed.
    """

    def steps(a: int, others: NDArray[np.int64]) -> Array:
        """How far (M,) other images are from one, in units of the largest step allowed."""
        return motion_steps(poses[a], poses[others], step_m, step_deg) - _ROUNDING

    gaps: list[tuple[float, int, int]] = []

    def add_gap(a: int, b: int) -> None:
        size = float(steps(a, np.array([b]))[0])
        if b - a > 1 and size > 1:
            heapq.heappush(gaps, (-size, a, b))

    for a, b in pairwise(kept.tolist()):
        add_gap(a, b)
    support: list[int] = []
    while gaps and len(support) < most:
        size, a, b = heapq.heappop(gaps)
        between = np.arange(a + 1, b)
        parts = math.ceil(-size)
        # The larger of the steps that remain when either side is cut evenly into its share of the parts.
        remaining = np.maximum(steps(a, between) / (parts // 2), steps(b, between) / (parts - parts // 2))
        best = float(remaining.min())
        good = np.flatnonzero(remaining <= min(_UNEVEN * best, max(best, 1.0)))
        sharpest = good[np.lexsort((remaining[good], -sharpness[between[good]]))[0]]
        cut = int(between[sharpest])
        support.append(cut)
        add_gap(a, cut)
        add_gap(cut, b)
    return np.array(sorted(support), dtype=np.int64)


def motion_steps(a: Array, b: Array, step_m: float, step_deg: float) -> Array:
    """How far (N,) poses b (N, 4, 4) are from a (N, 4, 4) or (4, 4), in steps of step_m or step_deg, whichever are more
    (0: no matter)."""
    a_T_b = relative(a, b)
    metres, angle_deg = np.linalg.norm(a_T_b[:, :3, 3], axis=1), np.degrees(rotation_angle(a_T_b[:, :3, :3]))
    return np.maximum(metres / step_m if step_m else 0 * metres, angle_deg / step_deg if step_deg else 0 * angle_deg)


def travelled_steps(poses: Array, step_m: float, step_deg: float) -> Array:
    """How far (N,) the walk has gone at each of its poses (N, 4, 4), in steps as `motion_steps` counts them."""
    return np.concatenate([[0.0], np.cumsum(motion_steps(poses[:-1], poses[1:], step_m, step_deg))])


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
