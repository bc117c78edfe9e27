"""Which images of a capture are used: frames of the dataset, and support frames for SfM between them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, Session, poses_of
from groundwalk.capture_import.sampling import motion_steps, sample_between, sample_halfway, sample_motion, sample_rate
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.store.hints import setting_of

# Largest steps between neighbouring images of SfM: of real corridors and rooms at a frame a second, matches get few
# beyond.
_STEP_M, _STEP_DEG = 0.3, 15.0
# Sampling that is this much denser and still gives too few frames won't by being denser.
_MAX_DENSITY = 2.0**12
_HALVINGS = 10


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
    sharpness, poses = _sharpness(session), poses_of(images)
    if settings.sampling == "rate" or not session.has_poses:
        return sample_rate(_times(session), sharpness, settings.rate_hz * density)
    if density == 1:
        return sample_motion(poses, sharpness, settings.step_m, settings.step_deg)
    # Steps from one frame to the next come in whole images, twice as many all at once; ticks don't.
    steps = motion_steps(poses[:-1], poses[1:], settings.step_m, settings.step_deg)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    return sample_rate((1e9 * walked).astype(np.int64), sharpness, density)


def _times(session: Session) -> NDArray[np.int64]:
    return np.array([image.t_ns for image in session.images], dtype=np.int64)


def _sharpness(session: Session) -> NDArray[np.float64]:
    return np.array([image.check.sharpness for image in session.images])
