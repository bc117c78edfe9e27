"""Which images of a capture are used: frames of the dataset, and support frames for SfM between them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import RawFrame
from groundwalk.capture_import.intake import Image, ImportedSession
from groundwalk.capture_import.sampling import (
    motion_candidates,
    rate_candidates,
    sample_motion,
    sample_rate,
    sample_support,
    support_cells,
    travelled_steps,
)
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import Array
from groundwalk.store.hints import setting_of

# Sampling that is this much denser and still gives too few frames won't by being denser.
_MAX_DENSITY = 2.0**12
_HALVINGS = 10
# Images are grouped for the choice of support frames into so many times as many groups as are used in the end.
_CELLS_A_FRAME = 4.0


@dataclass(frozen=True)
class Selection:
    """A session's images that are used, in order of time, and which (N,) of them are support frames."""

    images: list[Image]
    support: NDArray[np.bool_]


def select(sessions: Sequence[ImportedSession], settings: ImportSettings, density: float = 1.0) -> dict[str, Selection]:
    """The selection of each session, by its id; sampled so many times more densely than by the settings."""
    return {session.session_id: _select(session, settings, density) for session in sessions}


def select_enough(
    sessions: Sequence[ImportedSession], settings: ImportSettings
) -> tuple[dict[str, Selection], str | None]:
    """The selection of each session of a capture, by its id, and a line for the user where it's sampled more densely
    than by its settings."""
    by_settings = select(sessions, settings)
    density = density_for(sessions, settings)
    if density == 1:
        return by_settings, None
    used = select(sessions, settings, density)
    fewer, count = _dataset_size(by_settings), _dataset_size(used)
    if fewer == count:
        return used, None
    images = sum(len(session.images) for session in sessions)
    return used, (
        f"sampling by its settings selects {fewer} of {images} images, fewer than {settings.min_frames} "
        f"({setting_of('import', 'min_frames')}): "
        + ("all are used" if count == images else f"sampled {density:.2f} times as densely, {count} are used")
    )


def density_for(sessions: Sequence[ImportedSession], settings: ImportSettings) -> float:
    """How many times more densely than by its settings a capture has to be sampled for `min_frames`: 1 where that is
    enough, infinity where it takes every image."""
    images = sum(len(session.images) for session in sessions)

    def enough(density: float) -> bool:
        return sum(len(_sampled(session, settings, density)) for session in sessions) >= settings.min_frames

    if settings.sampling == "all" or enough(1.0):
        return 1.0
    if images <= settings.min_frames:
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


def windows_of(frames: Sequence[RawFrame], settings: ImportSettings) -> list[NDArray[np.int64]]:
    """Indices of the images from each group of which sampling uses the sharpest, at the density of the settings;
    `frames` are the rows with an image, in order of time."""
    if not frames or settings.sampling == "all":
        return [np.array([i]) for i in range(len(frames))]
    if settings.sampling == "rate":
        return rate_candidates(np.array([f.t_ns for f in frames], dtype=np.int64), settings.rate_hz)
    return motion_candidates(_poses(frames), settings.step_m, settings.step_deg)


def cells_of(frames: Sequence[RawFrame], with_image: Sequence[RawFrame], settings: ImportSettings) -> NDArray[np.int64]:
    """`support_cells` (N,) of the rows with an image; `frames` are these and all others of the session with a pose."""
    travelled = travelled_steps(_poses(frames), settings.support_step_m, settings.support_step_deg)
    at = dict(zip([frame.number for frame in frames], travelled.tolist(), strict=True))
    windows = windows_of(with_image, settings)
    max_cells = _CELLS_A_FRAME * (1 + settings.max_support_fraction) * len(windows)
    return support_cells(np.array([at[frame.number] for frame in with_image]), windows, max_cells)


def _select(session: ImportedSession, settings: ImportSettings, density: float) -> Selection:
    frames = _sampled(session, settings, density)
    support = np.empty(0, dtype=np.int64)
    max_support = math.floor(settings.max_support_fraction * len(frames))
    if max_support:
        images = [image.frame for image in session.images]
        support = sample_support(
            _poses(images),
            _sharpness(session.images),
            cells_of(session.frames, images, settings),
            frames,
            settings.support_step_m,
            settings.support_step_deg,
            max_support,
        )
    used = np.sort(np.concatenate([frames, support]))
    return Selection([session.images[i] for i in used], np.isin(used, support))


def _sampled(session: ImportedSession, settings: ImportSettings, density: float) -> NDArray[np.int64]:
    """Indices of the session's images that become frames of the dataset."""
    images = session.images
    has_times = session.recording.clock.has_times
    if not images or settings.sampling == "all" or math.isinf(density) or not has_times:
        return np.arange(len(images))
    sharpness, poses = _sharpness(images), _poses([image.frame for image in images])
    if settings.sampling == "rate":
        t_ns = np.array([i.frame.t_ns for i in images], dtype=np.int64)
        return sample_rate(t_ns, sharpness, settings.rate_hz * density)
    if density == 1:
        return sample_motion(poses, sharpness, settings.step_m, settings.step_deg)
    # Steps from one frame to the next come in whole images, twice as many all at once; ticks don't.
    travelled = travelled_steps(poses, settings.step_m, settings.step_deg)
    return sample_rate((1e9 * travelled).astype(np.int64), sharpness, density)


def _dataset_size(used: dict[str, Selection]) -> int:
    return sum(int((~selection.support).sum()) for selection in used.values())


def _poses(frames: Sequence[RawFrame]) -> Array:
    return np.array([frame.vio_T_cam for frame in frames], dtype=float).reshape(-1, 4, 4)


def _sharpness(images: Sequence[Image]) -> NDArray[np.float64]:
    return np.array([i.check.sharpness for i in images])
