"""Fits against evo's and COLMAP's own estimators, and the inputs that determine no fit."""

from collections.abc import Callable

import numpy as np
import pycolmap
import pytest
from evo.core.geometry import umeyama_alignment
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import (
    Sim3,
    fit_poses,
    fit_robust,
    fit_se3,
    fit_sim3,
    fit_yaw,
    mean_direction,
    pose_residuals,
    rotation_to_up,
    sim3_between,
)
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from tests.known import there

seeds = st.integers(0, 2**32 - 1)


def random_sim3(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.normal())), Rotation.random(rng=rng).as_matrix(), rng.normal(0, 10, 3))


def noisy_pair(rng: np.random.Generator, count: int = 30) -> tuple[np.ndarray, np.ndarray]:
    b = rng.normal(0, 3, (count, 3))
    return random_sim3(rng).points(b) + rng.normal(0, 0.3, (count, 3)), b


@settings(max_examples=25)
@given(seeds)
def test_least_squares_fits_agree_with_evo_and_colmap(seed: int) -> None:
    a, b = noisy_pair(np.random.default_rng(seed))
    fitted = fit_sim3(a, b)

    rotation, translation, scale = umeyama_alignment(b.T, a.T, with_scale=True)
    np.testing.assert_allclose(fitted.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(fitted.translation, translation, atol=1e-9)
    assert fitted.scale == pytest.approx(scale, abs=1e-9)

    colmap = pycolmap.estimate_sim3d(b, a)
    np.testing.assert_allclose(fitted.points(b), [colmap * x for x in b], atol=1e-9)

    rotation, translation, _ = umeyama_alignment(b.T, a.T, with_scale=False)
    np.testing.assert_allclose(fit_se3(a, b), make_pose(rotation, translation), atol=1e-9)
    np.testing.assert_allclose(fit_se3(a, b)[:3], there(pycolmap.estimate_rigid3d(b, a)).matrix(), atol=1e-9)


@settings(max_examples=25)
@given(seeds, st.integers(1, 8), st.booleans())
def test_pose_fit_recovers_even_straight_paths_and_single_poses(seed: int, count: int, yaw_only: bool) -> None:
    rng = np.random.default_rng(seed)
    straight = np.arange(count)[:, None] * rng.normal(size=3)
    b_T_cam = make_pose(Rotation.random(count, rng=rng).as_matrix(), straight)
    turn = yaw_rotation(rng.uniform(-3, 3)) if yaw_only else Rotation.random(rng=rng).as_matrix()
    a_T_b = make_pose(turn, rng.normal(0, 5, 3))
    fitted = fit_poses(a_T_b @ b_T_cam, b_T_cam, position_sd_m=0.02, rotation_sd=0.01, yaw_only=yaw_only)
    np.testing.assert_allclose(fitted, a_T_b, atol=1e-9)
    metres, radians = pose_residuals(a_T_b @ b_T_cam, b_T_cam, fitted)
    assert metres.max() < 1e-8 and radians.max() < 1e-7


@settings(max_examples=25)
@given(seeds)
def test_similarities_compose_and_invert(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_S_b, b_S_c, x = random_sim3(rng), random_sim3(rng), rng.normal(size=(5, 3))
    np.testing.assert_allclose((a_S_b @ b_S_c).points(x), a_S_b.points(b_S_c.points(x)), atol=1e-9)
    np.testing.assert_allclose(a_S_b.inverse().points(a_S_b.points(x)), x, atol=1e-9)
    cam = make_pose(Rotation.random(rng=rng).as_matrix(), x[0])
    np.testing.assert_allclose(a_S_b.poses(cam)[:3, 3], a_S_b.points(x[0]), atol=1e-12)


@settings(max_examples=25)
@given(seeds)
def test_robust_fit_lets_a_fifth_of_gross_outliers_go(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = rng.normal(0, 3, (30, 3))
    truth = random_sim3(rng)
    a = truth.points(b) + truth.scale * rng.normal(0, 0.01, b.shape)
    wrong = rng.choice(30, 6, replace=False)
    a[wrong] += truth.scale * rng.normal(0, 20, (6, 3))
    fitted, weights = fit_robust(
        lambda w: fit_sim3(a, b, w),
        lambda model: np.linalg.norm(a - model.points(b), axis=1),
        30,
        floor=0.005 * truth.scale,
    )
    left = np.linalg.norm(fitted.points(b) - truth.points(b), axis=1) / truth.scale
    assert left.max() < 0.05
    assert np.median(weights) > 0.3


@settings(max_examples=50)
@given(seeds)
def test_rotation_to_up_is_the_smallest(seed: int) -> None:
    up = mean_direction(np.random.default_rng(seed).normal(size=(1, 3)))
    rotation = rotation_to_up(3 * up)
    np.testing.assert_allclose(rotation @ up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert Rotation.from_matrix(rotation).magnitude() == pytest.approx(np.arccos(up[1]), abs=1e-7)
    np.testing.assert_allclose(rotation_to_up([0, -2, 0]) @ [0, -1, 0], [0, 1, 0])


line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
vertical = np.outer(np.arange(5.0), [0.0, 1.0, 0.0])


@pytest.mark.parametrize("fit", [fit_sim3, fit_se3])
@pytest.mark.parametrize("points", [np.eye(3)[:2], line, np.ones((4, 3))])
def test_undetermined_rotations_are_refused(fit: Callable[[Array, Array], object], points: Array) -> None:
    with pytest.raises(GeometryError):
        fit(points, points)


def test_other_undetermined_fits_are_refused() -> None:
    with pytest.raises(GeometryError):
        fit_yaw(vertical, vertical)
    with pytest.raises(GeometryError):
        fit_sim3(np.full((4, 3), 0.1), np.full((4, 3), 0.3), line_ok=True)
    assert fit_sim3(2 * line, line, line_ok=True).scale == pytest.approx(2)
    with pytest.raises(GeometryError):
        fit_poses(np.empty((0, 4, 4)), np.empty((0, 4, 4)), position_sd_m=1, rotation_sd=1)
    with pytest.raises(GeometryError):
        fit_sim3(line, line[:3])
    with pytest.raises(GeometryError):
        mean_direction([[0, 1, 0], [0, -1, 0]])
    with pytest.raises(GeometryError):
        rotation_to_up([0, 0, 0])


def test_a_similarity_between_poses_is_found_again_also_along_a_line() -> None:
    rng = np.random.default_rng(0)
    a_S_b = Sim3(2.5, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    for xyz in (rng.normal(size=(6, 3)), np.outer(np.arange(2.0), [1, 2, 3])):
        b_T_cam = make_pose(Rotation.random(len(xyz), rng).as_matrix(), xyz)
        found = sim3_between(a_S_b.poses(b_T_cam), b_T_cam)
        assert found.scale == pytest.approx(a_S_b.scale)
        np.testing.assert_allclose(found.points(xyz), a_S_b.points(xyz), atol=1e-12)
        np.testing.assert_allclose(found.rotation, a_S_b.rotation, atol=1e-12)
    with pytest.raises(GeometryError, match="3 poses at one position"):
        sim3_between(*[np.tile(make_pose(np.eye(3), [1e3, 2, 3]), (3, 1, 1))] * 2)
