"""Of many frames, the matches by which they are mapped first.

COLMAP's incremental mapping spends on each frame what goes by the length of its features' tracks, and looks through all
keypoints of all frames before each adjustment: the square of the frames, where one place is walked through again and
again. Some matches of each pair place a camera as well as some hundreds, if they are of the same tracks in all pairs.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.sfm.database import Ints, image_id, keypoint_counts

_MATCHES_PER_PAIR = 64
_NEIGHBOURS = 2


def chosen_matches(pair_M: Ints, feature_M2: NDArray[np.integer[Any]], features: int, seed: int) -> NDArray[np.bool_]:
    """Which of M matches, sorted by their pairs, are mapped first, (M,): all of pairs that have few, and of others
    those of the features (M, 2; numbered through all frames) that draw the highest number.

    A feature's number is the highest of those that it and its neighbours, and theirs, by matches draw. So features of
    one track mostly have the same (min-wise hashing; Broder, "On the resemblance and containment of documents", 1997),
    pairs choose the same tracks, and tracks need not be told apart, which wrong matches join into few.
    """
    number = np.random.default_rng(seed).random(features)
    for _ in range(_NEIGHBOURS):
        highest = number.copy()
        for one, other in (feature_M2.T, feature_M2.T[::-1]):
            np.maximum.at(highest, one, number[other])
        number = highest
    order = np.lexsort((-number[feature_M2].sum(axis=1), pair_M))
    rank = np.arange(len(order)) - np.searchsorted(pair_M[order], pair_M[order])
    chosen = np.zeros(len(order), bool)
    chosen[order[rank < _MATCHES_PER_PAIR]] = True
    return chosen


def matched_features(database: Path) -> tuple[Ints, Ints, list[pycolmap.TwoViewGeometry], NDArray[np.int32]]:
    """Of a database of N frames: the number of each one's first feature and of all (N + 1,), where all frames' are
    numbered through; the rows of verified pairs (P, 2), their geometries, and the features that these match (M, 2)."""
    with pycolmap.Database.open(database) as opened:
        frames = opened.num_images()
        pair_ids, geometries = opened.read_two_view_geometries()
    start = np.concatenate([[0], np.cumsum(keypoint_counts(database, frames))])
    ends = np.array([pycolmap.pair_id_to_image_pair(i) for i in pair_ids], np.int64).reshape(-1, 2) - image_id(0)
    # Single precision, as they are many.
    of_pairs = [(start[rows] + g.inlier_matches).astype(np.int32) for rows, g in zip(ends, geometries, strict=True)]
    return start, ends, geometries, np.concatenate([np.empty((0, 2), np.int32), *of_pairs])


def write_thinned(source: Path, target: Path, seed: int) -> None:
    """Write the database `target`: `source`, of verified pairs, with some matches of each pair and the keypoints that
    have any."""
    start, ends, geometries, feature_M2 = matched_features(source)
    with pycolmap.Database.open(source) as database:
        keypoints = [database.read_keypoints(image_id(row)) for row in range(len(start) - 1)]
    pair_M = np.repeat(np.arange(len(ends)), [len(one.inlier_matches) for one in geometries])
    first_M2 = start[ends][pair_M]
    chosen = chosen_matches(pair_M, feature_M2, int(start[-1]), seed)
    is_kept = np.zeros(start[-1], bool)
    is_kept[feature_M2[chosen]] = True
    kept_before = np.concatenate([[0], np.cumsum(is_kept)])
    matches_left = (kept_before[feature_M2] - kept_before[first_M2])[chosen].astype(np.uint32)
    parts = np.split(matches_left, np.searchsorted(pair_M[chosen], np.arange(1, len(ends))))
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as database, pycolmap.DatabaseTransaction(database):
        database.clear_keypoints()
        database.clear_two_view_geometries()
        for row, of_frame in enumerate(keypoints):
            database.write_keypoints(image_id(row), of_frame[is_kept[start[row] : start[row + 1]]])
        for (a, b), geometry, of_pair in zip(ends.tolist(), geometries, parts, strict=True):
            geometry.inlier_matches = of_pair
            database.write_two_view_geometry(image_id(a), image_id(b), geometry)
