"""Averages against brute force, scipy and their defining properties."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.averages import geometric_median, karcher_mean, quaternion_mean
from groundwalk.geometry.poses import quaternion_angle

seeds = st.integers(0, 2**32 - 1)


def cost(points: np.ndarray, y: np.ndarray) -> float:
    return float(np.linalg.norm(points - y, axis=1).sum())


@given(seeds, st.integers(1, 9))
def test_geometric_median_beats_a_general_optimiser(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3)) * [1, 10, 0.1]
    ours = geometric_median(points)
    found = minimize(lambda y: cost(points, y), points.mean(axis=0), method="Nelder-Mead", options={"maxiter": 500})
    assert cost(points, ours) <= found.fun * (1 + 1e-9) + 1e-12


def test_geometric_median_stays_on_a_data_point() -> None:
    # The angle at the middle point is wider than 120 degrees, so it is the median itself.
    points = np.array([[0.0, 0, 0], [1, 0.1, 0], [2, 0, 0]])
    assert np.array_equal(geometric_median(points), points[1])
    assert np.array_equal(geometric_median(points[[0, 0, 2]]), points[0])
    assert np.array_equal(geometric_median(points[[0, 0, 0]]), points[0])


@given(seeds)
def test_rotation_averages_agree_for_close_rotations_and_ignore_signs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = Rotation.random(rng=rng)
    rotations = base * Rotation.from_rotvec(rng.normal(scale=0.02, size=(5, 3)))
    q = rotations.as_quat()
    flipped = q * rng.choice([-1.0, 1.0], size=(5, 1))
    assert np.allclose(quaternion_mean(flipped), quaternion_mean(q), atol=1e-12)
    assert np.degrees(quaternion_angle(quaternion_mean(q), karcher_mean(q))) < 1e-2
    assert np.degrees(quaternion_angle(quaternion_mean(q), rotations.mean().as_quat())) < 1e-2


@pytest.mark.parametrize("average", [geometric_median, quaternion_mean])
def test_nothing_has_no_average(average: Callable[[np.ndarray], object]) -> None:
    with pytest.raises(GeometryError):
        average(np.zeros((0, 4)))
