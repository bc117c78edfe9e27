"""The pairs of a scene that are worth matching, by settings: from time, VIO and image retrieval."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.sfm.database import read_descriptors
from groundwalk.sfm.pairs import candidates
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.odometry import Odometry, drift_between
from groundwalk.sfm.pairs.retrieval import retrieval_pairs, vlad
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
        described = vlad(read_descriptors(database, len(vio.session)), seed)
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
