"""Rows of tables: some of them, evenly, and sums by group."""

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array


def evenly(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `count` rows (K,), evenly over them, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def summed(values: Array, group: NDArray[np.int64], groups: int) -> Array:
    """Sums of values (M, ...) by group (groups, ...)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    # Of no values, bincount gives whole numbers.
    total = np.stack([np.bincount(group, column, minlength=groups) for column in flat.T], axis=1).astype(float)
    return total.reshape(groups, *values.shape[1:])
