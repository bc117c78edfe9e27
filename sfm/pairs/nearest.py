"""SIFT matches by comparing all descriptors of two images with each other."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

_LENGTH = 512.0
_MAX_ANGLE, _MAX_RATIO = 0.7, 0.8  # COLMAP's


def mutual_matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Rows (M, 2) of SIFT descriptors (A, 128) and (B, 128), of length 512, that are each other's nearest.

    The angle between them is at most 0.7 rad, and below 0.8 of the angle to either one's second nearest (Lowe,
    "Distinctive image features from scale-invariant keypoints", IJCV 2004). Products of such whole numbers are exact in
    single precision, so the matches are the same in any order and on any number of threads.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.uint32)
    return _mutual(a @ b.T)


def guided_matches(
    a: NDArray[np.float32], b: NDArray[np.float32], fits: Callable[[Ints, Ints], NDArray[np.bool_]]
) -> NDArray[np.uint32]:
    """As `mutual_matches`, among rows i (C,) of a and j (C,) of b that fit each other, (C,): of `fits`' two arguments.

    What doesn't fit is no second nearest either, so that a feature of a repeated pattern can match.
    """
    product = a @ b.T
    # A second nearest beyond this angle refuses no match.
    i, j = np.nonzero(product >= _LENGTH**2 * np.cos(_MAX_ANGLE / _MAX_RATIO))
    fit = fits(i, j)
    fitting = np.zeros_like(product)
    fitting[i[fit], j[fit]] = product[i[fit], j[fit]]
    return _mutual(fitting)


def _mutual(product: NDArray[np.float32]) -> NDArray[np.uint32]:
    nearest = product.argmax(axis=1)
    mutual = product.max(axis=1) == product.max(axis=0)[nearest]
    # Of two that are equally near one is used, and refused below: its second nearest is just as near.
    j, first = np.unique(nearest[mutual], return_index=True)
    i = np.flatnonzero(mutual)[first]
    best = product[i, j]
    product[i, j] = -1.0
    second = np.maximum(product.max(axis=1)[i], product.max(axis=0)[j])
    angle, second_angle = (np.arccos(np.minimum(p / _LENGTH**2, 1.0)) for p in (best, second))
    is_match = (angle <= _MAX_ANGLE) & (angle < _MAX_RATIO * second_angle)
    order = np.argsort(i[is_match])
    return np.column_stack([i[is_match], j[is_match]])[order].astype(np.uint32)
