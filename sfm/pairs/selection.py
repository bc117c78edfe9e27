"""The pairs of a scene that are worth matching, by settings: from time, VIO and image retrieval."""

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.artefacts.choices import PairOrigin
from groundwalk.sfm.database import read_descriptors
from groundwalk.sfm.extensions import described_by
from groundwalk.sfm.pairs.candidates import (
    Pairs,
    sequence_pairs,
    strongest_pairs,
    transitive_pairs,
    unique_pairs,
    vio_pairs,
    within_vio_limits,
)
from groundwalk.sfm.pairs.odometry import Odometry, drift_between
from groundwalk.sfm.pairs.retrieval import retrieval_pairs
from groundwalk.sfm.settings import SfmSettings

Proposals = list[tuple[PairOrigin, Pairs]]


def pairs_within_sessions(
    settings: SfmSettings, frames: pd.DataFrame, recording_N: NDArray[np.object_], vio: Odometry
) -> Proposals:
    """Pairs from the order of the frames, and from the overlap of views by VIO."""
    # Support frames lie between the dataset's, and pairs are to reach as far as without them.
    density = len(frames) / max(int((~frames["support"]).sum()), 1)
    following = sequence_pairs(recording_N, frames["t_ns"], round(density * settings.sequence_pairs))
    # The next frame is always tried: that is what ties a recording together where VIO jumped.
    next_frame = sequence_pairs(recording_N, frames["t_ns"], 1)
    near = vio_pairs(
        vio.session,
        vio.vio_T_cam,
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        frames[["width", "height"]].to_numpy(float),
        settings.vio_max_distance_m,
        settings.vio_max_angle_deg,
        round(density * settings.vio_pairs),
    )
    in_sequence = unique_pairs(np.concatenate([next_frame, following[_may_overlap(settings, vio, following)]]))
    return [(PairOrigin.SEQUENCE, in_sequence), (PairOrigin.VIO, near)]


def pairs_across_sessions(settings: SfmSettings, session_N: NDArray[np.object_], database: Path, seed: int) -> Pairs:
    """Pairs of similar images of different sessions, by their features in the database."""
    if not settings.retrieval_pairs or len(set(session_N)) < 2:
        return unique_pairs([])
    descriptors = read_descriptors(database, len(session_N))
    described = described_by(settings.retrieval, descriptors, settings.retrieval_words, seed)
    return retrieval_pairs(described, session_N, settings.retrieval_pairs)


def pairs_of_chains(settings: SfmSettings, vio: Odometry, pairs: Pairs, inliers_P: NDArray[np.int64]) -> Pairs:
    """Pairs of frames that both match a third one, of those not tried yet."""
    candidates, strength = transitive_pairs(pairs, inliers_P, len(vio.session))
    may_overlap = _may_overlap(settings, vio, candidates)
    return strongest_pairs(candidates[may_overlap], strength[may_overlap], settings.transitive_pairs)


def _may_overlap(settings: SfmSettings, vio: Odometry, pairs: Pairs) -> NDArray[np.bool_]:
    """Whether the frames of each pair are near enough by VIO to see the same thing, its drift allowed for, (P,)."""
    drift_m, drift_rad = drift_between(vio, pairs, settings.vio_drift)
    max_m, max_deg = settings.vio_max_distance_m + drift_m, settings.vio_max_angle_deg + np.degrees(drift_rad)
    return within_vio_limits(pairs, vio.session, vio.vio_T_cam, max_m, max_deg)
