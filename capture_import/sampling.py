"""Which images of a capture are used: frames of the dataset by rate, and support frames for SfM between them."""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Session, poses_of
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import Array, relative, rotation_angle
from groundwalk.store.hints import setting_of

# Largest steps between neighbouring images of SfM: of real corridors and rooms at a frame a second, matches get few
# beyond.
_STEP_M, _STEP_DEG = 0.3, 15.0
# Sampling that is this much denser and still gives too few frames won't by being denser.
_MAX_DENSITY = 2.0**12
_HALVINGS = 10
# Around each tick of the rate the sharpest image within this fraction of the interval is used: a wider window would
# have sharper ones, but steps between frames would no longer be near the interval.
_WINDOW = 0.25
# Of images that cut a gap nearly as evenly as the best one, the sharpest is used: with steps up to this much larger.
_UNEVEN = 1.25
# Steps of exactly the limit may come out a rounding error larger.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Selection:
    """A session's images that are used, in order of time, and which (N,) of them are support frames."""

    images: list[Image]
    support: NDArray[np.bool_]


def select(sessions: Sequence[Session], settings: ImportSettings, density: float = 1.0) -> dict[str, Selection]:
    """The selection of each session, by its id; sampled so many times more densely than by the settings."""
    selected = {}
    for session in sessions:
        frames = _sampled(session, settings, density)
        most = math.floor(settings.max_support_fraction * len(frames))
        times, sharpness = _times(session), _sharpness(session)
        if not session.has_poses:
            support = sample_halfway(times, sharpness, frames)[:most]
        else:
            poses = poses_of(session.images)
            support = sample_between(poses, sharpness, frames, _STEP_M, _STEP_DEG, most) if most else frames[:0]
        used = np.sort(np.concatenate([frames, support]))
        selected[session.session_id] = Selection([session.images[i] for i in used], np.isin(used, support))
    return selected


def select_enough(sessions: Sequence[Session], settings: ImportSettings) -> tuple[dict[str, Selection], str | None]:
    """The selection of each session of a capture, by its id, and a line for the user where it's sampled more densely
    than by its settings."""
    by_settings = select(sessions, settings)
    density = density_for(sessions, settings)
    if density == 1:
        return by_settings, None
    used = select(sessions, settings, density)
    fewer, count = (sum(int((~s.support).sum()) for s in chosen.values()) for chosen in (by_settings, used))
    if fewer == count:
        return used, None
    images = sum(len(session.images) for session in sessions)
    return used, (
        f"sampling by its settings selects {fewer} of {images} images, fewer than {settings.min_frames} "
        f"({setting_of('import', 'min_frames')}): "
        + ("all are used" if count == images else f"sampled {density:.2f} times as densely, {count} are used")
    )


def density_for(sessions: Sequence[Session], settings: ImportSettings) -> float:
    """How many times more densely than by its settings a capture has to be sampled for `min_frames`: 1 where that is
    enough, infinity where it takes every image."""

    def enough(density: float) -> bool:
        return sum(len(_sampled(session, settings, density)) for session in sessions) >= settings.min_frames

    if settings.sampling == "all" or enough(1.0):
        return 1.0
    if sum(len(session.images) for session in sessions) <= settings.min_frames:
        return math.inf
    low, high = 1.0, 2.0
    while not enough(high):
        low, high = high, 2 * high
        if high > _MAX_DENSITY:
            return math.inf
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _sampled(session: Session, settings: ImportSettings, density: float) -> NDArray[np.int64]:
    """Indices of the session's images that become frames of the dataset."""
    images = session.images
    if not images or settings.sampling == "all" or math.isinf(density) or not session.recording.clock.has_times:
        return np.arange(len(images))
    return sample_rate(_times(session), _sharpness(session), settings.rate_hz * density)


def _times(session: Session) -> NDArray[np.int64]:
    return np.array([image.t_ns for image in session.images], dtype=np.int64)


def _sharpness(session: Session) -> NDArray[np.float64]:
    return np.array([image.check.sharpness for image in session.images])


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
        from_a, from_b = (motion_steps(poses[end], poses[between], step_m, step_deg) for end in (a, b))
        remaining = np.maximum(from_a / before, from_b / (steps - before))
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
