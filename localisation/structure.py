"""Points triangulated from training frames alone, whose poses are fixed."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.localisation.feature_kinds import SIFT_RATIO
from groundwalk.localisation.frames import Views, rays
from groundwalk.localisation.matching import covisible_pairs, mutual_matches, unit
from groundwalk.localisation.tracks import Points, Rays, epipolar_error_px, tracks, triangulate
from groundwalk.store.parallel import in_parallel

Ints = NDArray[np.int64]

# Fewer have no principal components and no words.
MIN_POINTS = 100
MAX_EPIPOLAR_PX = 2.5
MAX_PX = 2.0
MIN_ANGLE_DEG = 1.0
_LARGEST_REACH_M = 15.0


@dataclass(frozen=True)
class Structure:
    """The points of N frames, the frames' features one after the other: of each its frame (F,), px (F, 2), and
    descriptor (F, D)."""

    views: Views
    points: Points
    view: Ints
    px: NDArray[np.float32]
    descriptors: NDArray[Any]


@dataclass(frozen=True)
class Matches:
    """All features of N frames as rays, and which of them (M, 2) match."""

    features: tuple[Features, ...]
    rays: Rays
    first: Ints
    pairs: Ints


def matched_features(
    views: Views,
    features: Sequence[Features],
    per_view: int,
    ratio: float = SIFT_RATIO,
    track: Callable[[Sequence[Ints]], Iterable[Ints]] = lambda pairs: pairs,
) -> Ints:
    """Matches (M, 2) of frames that see the same by their poses, of which the rays meet: features, numbered over all
    frames. `ratio` as in `mutual_matches`."""
    first = np.cumsum([0, *(len(f) for f in features)])
    extent = np.array([[c.width / c.fx, c.height / c.fy] for c in views.cameras]) / 2
    positions = views.map_T_cam[:, :3, 3]
    reach_m = min(_LARGEST_REACH_M, max(1.0, float(np.linalg.norm(np.ptp(positions, axis=0)))))
    pairs = covisible_pairs(views.map_T_cam, extent, reach_m, per_view)
    every = _all_rays(views, features)
    descriptors = [unit(f.descriptors) for f in features]

    def matched(pair: Ints) -> Ints:
        a, b = pair.tolist()
        rows = mutual_matches(descriptors[a], descriptors[b], ratio) + first[pair]
        error = epipolar_error_px(every[rows[:, 0]], every[rows[:, 1]])
        return rows[error < MAX_EPIPOLAR_PX]

    return np.concatenate([np.empty((0, 2), np.int64), *in_parallel(matched, track(list(pairs)))])


def matches_of(views: Views, features: Sequence[Features], pairs: Ints) -> Matches:
    """The frames' features as rays, with the pairs (M, 2) that `matched_features` gave."""
    first = np.cumsum([0, *(len(f) for f in features)])
    return Matches(tuple(features), _all_rays(views, features), first, pairs)


def structure_of(views: Views, matches: Matches, used: NDArray[np.bool_] | None = None) -> Structure:
    """Points of the matches of the frames that are `used` (N,)."""
    view = matches.rays.view
    pairs = matches.pairs
    if used is not None:
        pairs = pairs[used[view[pairs]].all(axis=1)]
    point, feature = tracks(pairs, view)
    points = triangulate(matches.rays, point, feature, MAX_PX, MIN_ANGLE_DEG)
    whole = matches.features
    return Structure(
        views,
        points,
        view,
        np.concatenate([f.px for f in whole]),
        np.concatenate([f.descriptors for f in whole]),
    )


def _all_rays(views: Views, features: Sequence[Features]) -> Rays:
    parts = [rays(views, number, f.px.astype(float)) for number, f in enumerate(features)]
    counts = [len(f) for f in features]
    focal = np.repeat([(c.fx + c.fy) / 2 for c in views.cameras], counts)
    view = np.repeat(np.arange(len(features)), counts)
    return Rays(np.concatenate([o for o, _ in parts]), np.concatenate([d for _, d in parts]), focal, view)
