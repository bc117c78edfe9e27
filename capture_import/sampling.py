"""Choosing images of a walk: by rate, by motion, and between these so many that neighbours are near."""

import heapq
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array, relative, rotation_angle

# Around each tick of the rate the sharpest image within this fraction of the interval is used: a wider window would
# have sharper ones, but steps between frames would no longer be near the interval.
_WINDOW = 0.25
# Of images that cut a gap nearly as evenly as the best one, the sharpest is used: with steps up to this much larger.
_UNEVEN = 1.25
# Steps of exactly the limit may come out a rounding error larger.
_ROUNDING = 1e-9


def sample_rate(t_ns: NDArray[np.int64], sharpness: Array, rate_hz: float) -> NDArray[np.int64]:
    """Indices of one image an interval of 1/rate_hz: the sharpest within a quarter of the interval on either side of
    the tick, or else the nearest within half of it. Ticks without an image in reach are skipped."""
    since = (t_ns - t_ns[0]).astype(float) / (1e9 / rate_hz)
    tick = np.floor(since + 0.5)
    off = np.abs(since - tick)
    used = []
    for group in np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(tick)) + 1):
        near = group[off[group] <= _WINDOW]
        used.append(near[np.argmax(sharpness[near])] if len(near) else group[np.argmin(off[group])])
    return np.array(used, dtype=np.int64)


def sample_halfway(t_ns: NDArray[np.int64], sharpness: Array, frames: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices of one image between neighbouring `frames` (indices, rising), where there is any: the sharpest of those
    in the middle half of the time between them, or else the nearest to its middle."""
    used = []
    for a, b in pairwise(frames.tolist()):
        between = np.arange(a + 1, b)
        if len(between):
            off = np.abs((t_ns[between] - t_ns[a]) / (t_ns[b] - t_ns[a]) - 0.5)
            near = between[off <= _WINDOW]
            used.append(near[np.argmax(sharpness[near])] if len(near) else between[np.argmin(off)])
    return np.array(used, dtype=np.int64)


def sample_motion(poses: Array, sharpness: Array, step_m: float, step_deg: float) -> NDArray[np.int64]:
    """Indices of the sharpest image in each part of the walk that moves less than step_m and turns less than
    step_deg from its first image."""
    starts = [0]
    for i in range(1, len(poses)):
        step = relative(poses[starts[-1]], poses[i])
        if np.linalg.norm(step[:3, 3]) >= step_m or np.degrees(rotation_angle(step[:3, :3])) >= step_deg:
            starts.append(i)
    groups = np.split(np.arange(len(poses)), starts[1:])
    return np.array([group[np.argmax(sharpness[group])] for group in groups], dtype=np.int64)


def sample_between(
    poses: Array, sharpness: Array, frames: NDArray[np.int64], step_m: float, step_deg: float, max_count: int
) -> NDArray[np.int64]:
    """Indices of images between the `frames` (indices), so that neighbours are at most step_m and step_deg apart.

    Poses (N, 4, 4) and sharpness (N,) are those of all images in order of time, `frames` rises. The limits hold
    wherever there are images to hold them, by as few and as even steps as can be; where more than `max_count` would be
    needed, the largest steps are cut. Of images that do about as well the sharpest is used.
    """

    def cut(a: int, b: int, steps: int) -> list[int]:
        between = np.arange(a + 1, b)
        if steps < 2 or not len(between):
            return []
        # The larger of the steps that remain when either side is cut evenly.
        before = steps // 2
        remaining = np.maximum(
            motion_steps(poses[a], poses[between], step_m, step_deg) / before,
            motion_steps(poses[b], poses[between], step_m, step_deg) / (steps - before),
        )
        best = remaining.min()
        allowed = _UNEVEN * best if best > 1 else min(_UNEVEN * best, 1.0)
        good = np.flatnonzero(remaining <= allowed)
        middle = int(between[good[np.lexsort((remaining[good], -sharpness[between[good]]))[0]]])
        return [*cut(a, middle, before), middle, *cut(middle, b, steps - before)]

    used = frames
    while True:
        apart = motion_steps(poses[used[:-1]], poses[used[1:]], step_m, step_deg) - _ROUNDING
        steps = _even_steps(np.where(np.diff(used) > 1, apart, 0.0), max_count - (len(used) - len(frames)))
        added = [i for a, b, n in zip(used[:-1], used[1:], steps, strict=True) for i in cut(int(a), int(b), int(n))]
        if not added:
            return np.setdiff1d(used, frames)
        used = np.union1d(used, np.array(added, dtype=np.int64))


def motion_steps(a: Array, b: Array, step_m: float, step_deg: float) -> Array:
    """How far (N,) poses b (N, 4, 4) are from a (N, 4, 4) or (4, 4), in steps of step_m or step_deg, whichever are
    more."""
    a_T_b = relative(a, b)
    metres, angle_deg = np.linalg.norm(a_T_b[:, :3, 3], axis=1), np.degrees(rotation_angle(a_T_b[:, :3, :3]))
    return np.maximum(metres / step_m, angle_deg / step_deg)


def _even_steps(distances: Array, max_cuts: int) -> NDArray[np.int64]:
    """Into how many steps (N,) to cut each of these distances for all to be 1 at most, by no more than `max_cuts` cuts,
    the largest first."""
    steps = np.ones(len(distances), dtype=np.int64)
    largest = [(-float(distance), i) for i, distance in enumerate(distances) if distance > 1]
    heapq.heapify(largest)
    for _ in range(max_cuts):
        if not largest:
            break
        _, i = heapq.heappop(largest)
        steps[i] += 1
        if distances[i] > steps[i]:
            heapq.heappush(largest, (-float(distances[i]) / steps[i], i))
    return steps
