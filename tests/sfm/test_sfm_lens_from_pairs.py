"""Lens and readout time from pairs of images: matches of made-up cameras through known lenses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort, rational_of_fisheye
from groundwalk.geometry.poses import Array, make_pose, relative
from groundwalk.sfm.cameras.lens_from_pairs import PairMatches, estimate_lens, sampson_of

_PAIRS, _POINTS = 40, 120
_FOCAL_PX, _NOISE_PX = 480.0, 0.3
# A phone's main lens with k3; an equidistant fisheye lens up to 55 degrees from its axis.
_LENSES = {
    "k3": np.array([0.09, -0.12, 0.001, -0.001, 0.3, 0, 0, 0]),
    "fisheye": rational_of_fisheye([0.0, 0.0, 0.0, 0.0], 0.96, 1e-4),
}


def _matches(lens: Array, seed: int, extent: float) -> PairMatches:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.15, (2 * _PAIRS, 3))).as_matrix()
    pose = make_pose(turn, rng.normal(0, 0.6, (2 * _PAIRS, 3)))
    a_T_b = relative(pose[::2], pose[1::2])
    a_T_b[:, :3, 3] /= np.linalg.norm(a_T_b[:, :3, 3], axis=1, keepdims=True)
    depth = rng.uniform(3, 6, (_PAIRS, _POINTS, 1))
    xyz_a = depth * np.concatenate([rng.uniform(-extent, extent, (_PAIRS, _POINTS, 2)), np.ones_like(depth)], axis=2)
    xyz_b = np.einsum("pji,pmj->pmi", a_T_b[:, :3, :3], xyz_a - a_T_b[:, None, :3, 3])
    ideal_b = xyz_b[..., :2] / xyz_b[..., 2:]
    there = ((np.abs(ideal_b) < extent).all(axis=2) & (xyz_b[..., 2] > 1)).ravel()
    ideal = [at.reshape(-1, 2)[there] for at in (xyz_a[..., :2] / xyz_a[..., 2:], ideal_b)]
    xy = [distort(at, lens) + rng.normal(0, _NOISE_PX / _FOCAL_PX, at.shape) for at in ideal]
    pair = np.repeat(np.arange(_PAIRS), _POINTS)[there]
    row, focal, still = np.zeros(len(pair)), np.full(len(pair), _FOCAL_PX), np.zeros((_PAIRS, 6))
    ends = np.arange(2 * _PAIRS).reshape(-1, 2)
    return PairMatches(pair, xy[0], xy[1], row, row, focal, focal, a_T_b, still, still, ends, lens[2:])


@pytest.mark.parametrize("name", _LENSES)
def test_k1_and_k2_are_estimated_beside_the_coefficients_that_stay(name: str) -> None:
    lens = _LENSES[name]
    matches = _matches(lens, 0, 1.0 if name == "fisheye" else 0.6)
    start = np.array([lens[0] + 0.02, lens[1] - 0.03, 0.0])
    estimate = estimate_lens(matches, start, np.diag(np.array([0.1, 0.2, 1e-6]) ** -2.0))
    sd = np.sqrt(np.diag(estimate.covariance))
    assert (sd[:2] < 0.02).all()
    assert (np.abs(estimate.parameters[:2] - lens[:2]) < 4 * sd[:2]).all()


@pytest.mark.parametrize("stated", [(-0.6, 0.0), (-0.3, -0.4), (0.3, -1.0)])
def test_a_stated_lens_that_folds_back_within_the_image_leaves_finite_residuals(stated: tuple[float, float]) -> None:
    matches = _matches(np.array([0.09, -0.12, 0, 0, 0, 0, 0, 0]), 0, 0.6)
    estimate = estimate_lens(matches, np.array([*stated, 0.0]), np.diag([1e12, 1e12, 1e12]))
    assert np.allclose(estimate.parameters[:2], stated, atol=1e-3)
    residual = sampson_of(matches, estimate.a_T_b, estimate.parameters)
    assert np.isfinite(residual).all() and np.median(np.abs(residual)) > 5 * _NOISE_PX
