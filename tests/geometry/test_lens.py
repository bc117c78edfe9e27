"""Lens distortion against OpenCV's and COLMAP's."""

import cv2
import numpy as np
import pytest

from groundwalk.geometry.lens import distort, fold_radius, max_shift, undistort

_LENSES = [
    [0.092, -0.125],
    [0.16, -0.40],
    [0.09, -0.12, 0.001, -0.002],
    [0.1, -0.15, 0.0005, 0.0003, 0.02, 0.01, -0.01, 0.005],
]


def _image_points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-0.66, -0.5], [0.66, 0.5], (200, 2))


@pytest.mark.parametrize("lens", _LENSES)
def test_distort_is_opencvs(lens: list[float]) -> None:
    points = _image_points()
    rays = np.column_stack([points, np.ones(len(points))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens + [0.0] * (8 - len(lens))))
    assert np.allclose(distort(points, lens), expected.reshape(-1, 2), atol=1e-12)


@pytest.mark.parametrize("lens", _LENSES)
def test_undistort_inverts_distort_over_a_phones_image(lens: list[float]) -> None:
    points = _image_points()
    assert np.allclose(undistort(distort(points, lens), lens), points, atol=1e-9)


def test_max_shift_is_the_farthest_that_two_lenses_differ() -> None:
    assert max_shift([0.1], [0.1], (0.66, 0.5)) == 0.0
    assert max_shift([0.1], [0.0], (0.66, 0.5)) == pytest.approx(0.1 * np.hypot(0.66, 0.5) ** 3)


def test_a_lens_folds_back_where_its_radial_derivative_is_zero() -> None:
    k1, k2 = 0.083, -0.1455
    expected = np.sqrt((-3 * k1 - np.sqrt(9 * k1**2 - 20 * k2)) / (10 * k2))
    assert fold_radius([k1, k2]) == pytest.approx(expected, abs=2e-3)
    assert fold_radius([k1, 0.0]) == fold_radius([]) == np.inf
