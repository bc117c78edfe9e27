"""The held-out check: matches that took no part in mapping, and how well the finished poses explain them.

What is left out are whole tracks, all matches of a feature wherever it was seen: a match whose feature still ties other
frames together would be no independent check. The error is Sampson's, which needs no point fitted to the match, and
is taken of the matches that took part, too: where the poses follow their noise, theirs is the smaller one.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundwalk.sfm.pairs.candidates import Pairs

Ints = NDArray[np.int64]


def choose_held_out(
    pair_M: Ints, match_M2: Ints, pairs: Pairs, keypoints_N: Ints, fraction: float, seed: int
) -> NDArray[np.bool_]:
    """Which of M matches are left out, (M,): those of a `fraction` of the tracks.

    Match m ties the features `match_M2[m]` of the frames `pairs[pair_M[m]]`. A track that holds two features of one
    frame is wrong somewhere and never left out.
    """
    start = np.concatenate([[0], np.cumsum(keypoints_N)])
    a, b = (start[pairs[pair_M, side]] + match_M2[:, side] for side in (0, 1))
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(start[-1], start[-1]))
    count, track = connected_components(graph, directed=False)
    frame = np.repeat(np.arange(len(keypoints_N)), keypoints_N)
    places, counts = np.unique(track * np.int64(len(keypoints_N)) + frame, return_counts=True)
    consistent = np.ones(count, bool)
    consistent[places[counts > 1] // len(keypoints_N)] = False
    is_held_out = np.random.default_rng(seed).random(count) < fraction
    return np.asarray((is_held_out & consistent)[track[a]], bool)
