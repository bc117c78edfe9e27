"""The pairs of a scene that are worth matching, by settings: from time, VIO and image retrieval.

Images are similar by VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR
2010) with the normalisation of each word (Arandjelović and Zisserman, "All about VLAD", CVPR 2013) over words learned
from the scene's own features.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from groundwalk.geometry.vlad import aggregate, k_means
from groundwalk.sfm.database import descriptors_of
from groundwalk.sfm.pairs import candidates
from groundwalk.sfm.pairs.candidates import Pairs, unique_pairs
from groundwalk.sfm.pairs.odometry import Odometry, drift_between
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import PairOrigin
from groundwalk.store.tables import have_times

Proposals = list[tuple[PairOrigin, Pairs]]

# Views of a session that differ by more see too little in common for SIFT.
_MAX_ANGLE_DEG = 60.0
# Frames later in a recording that one is matched to, too: where frames are dense, the next few see it from nearly the
# same place, and baselines stay short (docs/explanation/decisions.md).
_FARTHER_STEPS = (8, 16, 32)
# Of as many frames without VIO all pairs are matched, some 20,000.
_MAX_EXHAUSTIVE = 200

_WORDS, _SAMPLES_PER_WORD = 64, 400
_ROWS_AT_ONCE = 512


def pairs_within_sessions(settings: SfmSettings, frames: pd.DataFrame, vio: Odometry) -> Proposals:
    """Pairs from the order of the frames, where they have times, and from the overlap of views by VIO."""
    # Support frames lie between the dataset's, and pairs are to reach as far as without them.
    density = len(frames) / max(int((~frames["support"]).sum()), 1)
    timed = np.flatnonzero(have_times(frames))
    recordings, t_ns = vio.recording[timed], vio.t_ns[timed]
    steps = {*range(1, round(density * settings.sequence_pairs) + 1), *_FARTHER_STEPS}
    following = timed[candidates.sequence_pairs(recordings, t_ns, sorted(steps))]
    # The next frame is always tried: that is what ties a recording together where VIO jumped.
    next_frame = timed[candidates.sequence_pairs(recordings, t_ns, [1])]
    near = candidates.vio_pairs(
        vio.session,
        vio.vio_T_cam,
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        frames[["width", "height"]].to_numpy(float),
        settings.vio_max_distance_m,
        _MAX_ANGLE_DEG,
        round(density * settings.vio_pairs),
    )
    following = following[_may_overlap(settings, vio, following)]
    in_sequence = candidates.unique_pairs(np.concatenate([next_frame, following]))
    return [(PairOrigin.SEQUENCE, in_sequence), (PairOrigin.VIO, near)]


def pairs_by_images(settings: SfmSettings, vio: Odometry, known: Proposals, database: Path, seed: int) -> Proposals:
    """Pairs of similar images, by their features in the database: of different sessions, and of recordings without VIO
    those that aren't `known` by time; where these have few frames together, all their pairs."""
    free = np.flatnonzero(~np.isin(vio.recording, vio.recording[vio.posed]))
    proposals: Proposals = []
    is_few = len(free) <= _MAX_EXHAUSTIVE
    if is_few:
        proposals.append((PairOrigin.EXHAUSTIVE, free[np.stack(np.triu_indices(len(free), 1), axis=1)]))
    across = len(set(vio.session)) > 1 and not (is_few and len(free) == len(vio.session))
    if settings.retrieval_pairs and (across or not is_few):
        with descriptors_of(database, len(vio.session)) as (read, counts):
            described = vlad(read, counts, seed)
        if not is_few:
            tried = np.concatenate([pairs for _, pairs in known])
            place = np.full(len(vio.recording), -1)
            place[free] = np.arange(len(free))
            within = place[tried][(place[tried] >= 0).all(axis=1)]
            similar = retrieval_pairs(described[free], vio.recording[free], settings.retrieval_pairs, within)
            proposals.append((PairOrigin.RETRIEVAL, free[similar]))
        if across:
            proposals.append((PairOrigin.RETRIEVAL, retrieval_pairs(described, vio.session, settings.retrieval_pairs)))
    return proposals


def pairs_of_chains(settings: SfmSettings, vio: Odometry, pairs: Pairs, inliers_P: NDArray[np.int64]) -> Pairs:
    """Pairs of frames that both match a third one, of those not tried yet: half as many as are tried for similarity."""
    chains, strength = candidates.transitive_pairs(pairs, inliers_P, len(vio.session))
    may_overlap = _may_overlap(settings, vio, chains)
    return candidates.strongest_pairs(chains[may_overlap], strength[may_overlap], settings.retrieval_pairs // 2)


def _may_overlap(settings: SfmSettings, vio: Odometry, pairs: Pairs) -> NDArray[np.bool_]:
    """Whether the frames of each pair are near enough by VIO to see the same thing, its drift allowed for, (P,)."""
    drift_m, drift_rad = drift_between(vio, pairs)
    max_m, max_deg = settings.vio_max_distance_m + drift_m, _MAX_ANGLE_DEG + np.degrees(drift_rad)
    return candidates.within_vio_limits(pairs, vio.session, vio.vio_T_cam, max_m, max_deg)


def vlad(read: Callable[[int], NDArray[np.uint8]], counts: ArrayLike, seed: int) -> NDArray[np.float32]:
    """Unit image descriptors (N, words * D) of N images, each of whose `counts` (N,) local descriptors (M, D) `read`
    gives; zero where that is 0, which it isn't of all."""
    rng = np.random.default_rng(seed)
    ends = np.cumsum(counts)
    sample = np.sort(rng.permutation(ends[-1])[: _WORDS * _SAMPLES_PER_WORD])
    image = np.searchsorted(ends, sample, side="right")
    within = sample - np.concatenate([[0], ends])[image]
    centres = k_means(_unit(np.concatenate([read(i)[within[image == i]] for i in np.unique(image)])), _WORDS, rng)
    nothing = np.zeros(centres.size, np.float32)
    return np.stack([aggregate(_unit(read(i)), centres) if n else nothing for i, n in enumerate(np.asarray(counts))])


def retrieval_pairs(
    image_ND: NDArray[np.float32], session_N: ArrayLike, per_frame: int, within: Pairs | None = None
) -> Pairs:
    """Each frame with the `per_frame` most similar frames of other sessions; or of its own, without the pairs `within`
    that are proposed there anyhow."""
    session_N = np.asarray(session_N)
    known = np.empty((2, 0), np.int64) if within is None else np.concatenate([within, within[:, ::-1]]).T
    proposed = [np.empty((0, 2), np.int64)]
    for start in range(0, len(image_ND), _ROWS_AT_ONCE):
        rows = np.arange(start, min(start + _ROWS_AT_ONCE, len(image_ND)))
        similarity = image_ND[rows] @ image_ND.T
        similarity[(session_N[rows, None] == session_N[None]) != (within is not None)] = -np.inf
        similarity[np.arange(len(rows)), rows] = -np.inf
        a, b = known[:, (known[0] >= start) & (known[0] <= rows[-1])]
        similarity[a - start, b] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :per_frame]
        is_other = np.isfinite(np.take_along_axis(similarity, best, axis=1))
        proposed.append(np.stack([np.broadcast_to(rows[:, None], best.shape)[is_other], best[is_other]], axis=1))
    return unique_pairs(np.concatenate(proposed))


def _unit(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)
