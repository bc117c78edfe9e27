"""Which of a session's sound images become frames of the dataset, and which support them in SfM."""

import heapq

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
    return _sharpest(rate_candidates(t_ns, rate_hz), sharpness)


def sample_motion(poses: Array, sharpness: Array, step_m: float, step_deg: float) -> NDArray[np.int64]:
    """Indices of the sharpest image in each part of the walk that moves less than step_m and turns less than
    step_deg from its first image."""
    return _sharpest(motion_candidates(poses, step_m, step_deg), sharpness)


def sample_support(
    poses: Array,
    sharpness: Array,
    cells: NDArray[np.int64],
    frames: NDArray[np.int64],
    step_m: float,
    step_deg: float,
    max_count: int,
) -> NDArray[np.int64]:
    """Indices of images between the `frames` (indices), so that neighbours are at most step_m and step_deg apart (0:
    any).

    Poses (N, 4, 4), sharpness (N,) and `support_cells` (N,) are those of all images in order of time, `frames` rises.
    The limits hold wherever there are images to hold them, by as few and as even steps as can be; where more than
    `max_count` would be needed, the largest steps are cut. Of images that do about as well the sharpest is used, and of
    each cell only its sharpest where that is enough.
    """
    first_choice = np.zeros(len(poses), dtype=bool)
    first_choice[_sharpest(np.split(np.arange(len(cells)), np.flatnonzero(np.diff(cells)) + 1), sharpness)] = True

    def cut(a: int, b: int, parts: int) -> list[int]:
        between = np.arange(a + 1, b)
        if parts < 2 or not len(between):
            return []
        if first_choice[between].any():
            between = between[first_choice[between]]
        # The larger of the steps that remain when either side is cut evenly into its number of parts.
        before = parts // 2
        remaining = np.maximum(
            motion_steps(poses[a], poses[between], step_m, step_deg) / before,
            motion_steps(poses[b], poses[between], step_m, step_deg) / (parts - before),
        )
        best = remaining.min()
        allowed = _UNEVEN * best if best > 1 else min(_UNEVEN * best, 1.0)
        good = np.flatnonzero(remaining <= allowed)
        sharpest = good[np.lexsort((remaining[good], -sharpness[between[good]]))[0]]
        middle = int(between[sharpest])
        return [*cut(a, middle, before), middle, *cut(middle, b, parts - before)]

    used = frames
    while True:
        steps = motion_steps(poses[used[:-1]], poses[used[1:]], step_m, step_deg) - _ROUNDING
        parts = _even_parts(np.where(np.diff(used) > 1, steps, 0.0), max_count - (len(used) - len(frames)))
        added = [i for a, b, n in zip(used[:-1], used[1:], parts, strict=True) for i in cut(int(a), int(b), int(n))]
        if not added:
            return np.setdiff1d(used, frames)
        used = np.union1d(used, np.array(added, dtype=np.int64))


def support_cells(travelled: Array, windows: list[NDArray[np.int64]], max_cells: float) -> NDArray[np.int64]:
    """Numbers (N,), rising, of cells of the walk from each of which support frames should need the sharpest image
    alone.

    A cell is of half a step at most by `travelled` (N,), in or between the `windows` from which sampling takes its
    frames. It's longer where there would be more than `max_cells`: so many images aren't used in the end.
    """
    window_of = np.full(len(travelled), -1)
    for number, window in enumerate(windows):
        window_of[window] = number
    size = 0.5
    while True:
        borders = (np.diff(window_of) != 0) | (np.diff(np.floor(travelled / size)) != 0)
        if np.count_nonzero(borders) < max(max_cells, 2 * len(windows) + 1):
            return np.concatenate([[0], np.cumsum(borders)]).astype(np.int64)
        size *= 2


def _even_parts(steps: Array, max_cuts: int) -> NDArray[np.int64]:
    """Into how many parts (N,) to cut each of these steps for all to be 1 at most, by no more than `max_cuts` cuts."""
    parts = np.ones(len(steps), dtype=np.int64)
    largest = [(-float(step), i) for i, step in enumerate(steps) if step > 1]
    heapq.heapify(largest)
    for _ in range(max_cuts):
        if not largest:
            break
        _, i = heapq.heappop(largest)
        parts[i] += 1
        if steps[i] > parts[i]:
            heapq.heappush(largest, (-float(steps[i]) / parts[i], i))
    return parts


def motion_steps(a: Array, b: Array, step_m: float, step_deg: float) -> Array:
    """How far (N,) poses b (N, 4, 4) are from a (N, 4, 4) or (4, 4), in steps of step_m or step_deg, whichever are more
    (0: any)."""
    a_T_b = relative(a, b)
    metres, angle_deg = np.linalg.norm(a_T_b[:, :3, 3], axis=1), np.degrees(rotation_angle(a_T_b[:, :3, :3]))
    return np.maximum(metres / step_m if step_m else 0 * metres, angle_deg / step_deg if step_deg else 0 * angle_deg)


def travelled_steps(poses: Array, step_m: float, step_deg: float) -> Array:
    """How far (N,) the walk has gone at each of its poses (N, 4, 4), in steps as `motion_steps` counts them."""
    return np.concatenate([[0.0], np.cumsum(motion_steps(poses[:-1], poses[1:], step_m, step_deg))])


def rate_candidates(t_ns: NDArray[np.int64], rate_hz: float) -> list[NDArray[np.int64]]:
    """For each tick of the rate, the indices of the images of which `sample_rate` uses the sharpest."""
    interval = 1e9 / rate_hz
    since = (t_ns - t_ns[0]).astype(float) / interval
    tick = np.floor(since + 0.5)
    off = np.abs(since - tick)
    candidates = []
    for group in np.split(np.arange(len(t_ns)), np.flatnonzero(np.diff(tick)) + 1):
        near = group[off[group] <= _WINDOW]
        candidates.append(near if len(near) else group[[np.argmin(off[group])]])
    return candidates


def motion_candidates(poses: Array, step_m: float, step_deg: float) -> list[NDArray[np.int64]]:
    """For each part of the walk, the indices of the images of which `sample_motion` uses the sharpest."""
    starts = [0]
    for i in range(1, len(poses)):
        step = relative(poses[starts[-1]], poses[i])
        if np.linalg.norm(step[:3, 3]) >= step_m or np.degrees(rotation_angle(step[:3, :3])) >= step_deg:
            starts.append(i)
    return np.split(np.arange(len(poses)), starts[1:])


def _sharpest(candidates: list[NDArray[np.int64]], sharpness: Array) -> NDArray[np.int64]:
    return np.array([group[np.argmax(sharpness[group])] for group in candidates], dtype=np.int64)
