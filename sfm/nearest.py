"""SIFT matches by comparing all descriptors of two images with each other."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from artefacts.cores import usable_cores
from sfm.database import image_id
from sfm.pairs import Pairs

_LENGTH = 512.0
_FARTHEST, _FARTHEST_SHARE = 0.7, 0.8  # COLMAP's


def write_nearest(database: Path, pairs: Pairs) -> None:
    """Match those of the pairs of rows (P, 2) that have no matches yet: a killed run may have left some unverified."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        todo = [(a, b) for a, b in pairs.tolist() if not opened.exists_matches(image_id(a), image_id(b))]
        descriptors = {row: opened.read_descriptors(image_id(row)).data.astype(np.float32) for row in set(chain(*todo))}
        with ThreadPoolExecutor(usable_cores()) as pool:
            found: Iterable[NDArray[np.uint32]] = pool.map(
                lambda pair: mutual_matches(descriptors[pair[0]], descriptors[pair[1]]), todo
            )
            for (a, b), matches in zip(todo, found, strict=True):
                opened.write_matches(image_id(a), image_id(b), matches)
                if not len(matches):
                    # Verification would leave the pair out, and it would count as one to be done.
                    opened.write_two_view_geometry(image_id(a), image_id(b), pycolmap.TwoViewGeometry())


def mutual_matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Rows (M, 2) of SIFT descriptors (A, 128) and (B, 128), of length 512, that are each other's nearest.

    The angle between them is at most 0.7 rad, and below 0.8 of the angle to either one's second nearest (Lowe,
    "Distinctive image features from scale-invariant keypoints", IJCV 2004). Products of such whole numbers are exact in
    single precision, so the matches are the same in any order and on any number of threads.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.uint32)
    product = a @ b.T
    nearest = product.argmax(axis=1)
    mutual = product.max(axis=1) == product.max(axis=0)[nearest]
    # Of two that are equally near one is taken, and thrown away below: its second nearest is just as near.
    j, first = np.unique(nearest[mutual], return_index=True)
    i = np.flatnonzero(mutual)[first]
    best = product[i, j]
    product[i, j] = -1.0
    second = np.maximum(product.max(axis=1)[i], product.max(axis=0)[j])
    angle, second_angle = (np.arccos(np.minimum(p / _LENGTH**2, 1.0)) for p in (best, second))
    kept = (angle <= _FARTHEST) & (angle < _FARTHEST_SHARE * second_angle)
    order = np.argsort(i[kept])
    return np.column_stack([i[kept], j[kept]])[order].astype(np.uint32)
