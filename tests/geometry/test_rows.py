"""Some rows evenly, and sums by group."""

import numpy as np

from groundwalk.geometry.rows import evenly, summed


def test_evenly_has_the_ends_and_never_more_than_asked_or_there_are() -> None:
    assert evenly(10, 4).tolist() == [0, 3, 6, 9]
    assert evenly(3, 5).tolist() == [0, 1, 2]
    assert evenly(0, 5).tolist() == []


def test_sums_by_group_keep_the_shape_and_are_zero_where_a_group_has_nothing() -> None:
    values = np.random.default_rng(0).normal(size=(6, 2, 3))
    total = summed(values, np.array([2, 0, 2, 2, 0, 2]), 4)
    assert np.allclose(
        total, [values[[1, 4]].sum(axis=0), np.zeros((2, 3)), values[[0, 2, 3, 5]].sum(axis=0), np.zeros((2, 3))]
    )
    assert summed(values[:0], np.zeros(0, np.int64), 2).dtype == float
