"""Poses from points: against known ones, COLMAP's, and their stated covariances."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.localisation.frames import Views
from groundwalk.localisation.pose import Observed, Priors, ransac, refine
from groundwalk.scoring.errors import normalised_squares, pose_error, position_error, rotation_error_deg
from tests.known import there
from tests.localisation.scenes import DOWN, HIGH, LOGGED, READOUT_S, SEEN_BY, place, projected, walk

PRIORS = Priors(angular_sd=0.2, velocity_sd=0.5, focal_sd=0.004, gravity_sd=0.001, pixel_sd=0.05)


def observed(
    views: Views,
    view: int,
    count: int = 150,
    noise_px: float = 0.0,
    outliers: int = 0,
    seed: int = 0,
    camera: Camera = SEEN_BY,
) -> Observed:
    rng = np.random.default_rng([seed, view])
    xyz = place(points=2500).xyz
    px = projected(views, view, xyz)
    rows = np.flatnonzero(np.isfinite(px).all(axis=1))[:count]
    px, xyz = px[rows] + noise_px * rng.standard_normal((len(rows), 2)), xyz[rows]
    px[:outliers] = rng.uniform([0, 0], [camera.width, camera.height], (outliers, 2))
    return Observed(px, camera.unproject(px), xyz)


def off(pose: Array, seed: int = 0, metres: float = 0.05, degrees: float = 1.0) -> Array:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal(3)).as_matrix()
    return pose @ make_pose(turn, metres * rng.standard_normal(3))


def test_ransac_finds_the_pose_among_outliers() -> None:
    views = walk(3, moving=False)
    seen = observed(views, 1, 150, noise_px=0.3, outliers=75)
    pose, inliers = there(ransac(seen.ideal, seen.xyz, 4 / 480, 2000, 0))
    assert inliers[75:].mean() > 0.85 and inliers[:75].mean() < 0.1
    assert position_error(pose, views.map_T_cam[1]) < 0.1 and rotation_error_deg(pose, views.map_T_cam[1]) < 1
    assert ransac(np.zeros((3, 2)), np.zeros((3, 3)), 0.01, 100, 0) is None


def test_without_shutter_and_noise_it_is_colmaps_pose() -> None:
    views = walk(3, moving=False)
    seen = observed(views, 1, noise_px=0.5)
    still = Priors(1e-6, 1e-6, 1e-6, 1e-3, 0.5)
    fit = refine(off(views.map_T_cam[1]), seen, LOGGED, 0.0, still, iterations=20)
    camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=[480, 480, 321, 239, *SEEN_BY.distortion])
    world = inverse(off(views.map_T_cam[1]))
    options = pycolmap.AbsolutePoseRefinementOptions()
    options.loss_function_scale = 2.385 * fit.expected_px[0]
    options.gradient_tolerance = 1e-12
    options.max_num_iterations = 200
    start = pycolmap.Rigid3d(pycolmap.Rotation3d(world[:3, :3]), world[:3, 3])
    found = pycolmap.refine_absolute_pose(start, seen.px, seen.xyz, np.ones(len(seen.px), bool), camera, options)
    colmap = inverse(np.vstack([there(found)["cam_from_world"].matrix(), [0, 0, 0, 1]]))
    # Residuals are on the undistorted image here, on the distorted one there.
    assert position_error(fit.map_T_cam, colmap) < 0.001 and rotation_error_deg(fit.map_T_cam, colmap) < 0.01


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("camera", [SEEN_BY, HIGH], ids=["wide", "high"])
def test_motion_and_focal_length_are_estimated(camera: Camera, stated: bool) -> None:
    views = walk(6, focal_sd=0.004, camera=camera)
    asked = camera if stated else replace(camera, first_row=None)
    for view in range(6):
        fit = refine(off(views.map_T_cam[view]), observed(views, view, camera=camera), asked, READOUT_S, PRIORS)
        assert position_error(fit.map_T_cam, views.map_T_cam[view]) < 0.01
        assert abs(fit.focal_factor - 1) < 0.02
        assert np.abs(fit.angular - views.angular[view]).max() < 0.04 and np.median(fit.residual_px) < 0.02


def test_covariance_holds_and_gravity_makes_it_smaller() -> None:
    views = walk(60, focal_sd=0.004)
    errors, covariances = [], []
    for view in range(60):
        truth = views.map_T_cam[view]
        seen = observed(views, view, 60, noise_px=0.4)
        fit = refine(off(truth, view), seen, LOGGED, READOUT_S, PRIORS)
        errors.append(pose_error(fit.map_T_cam, truth))
        covariances.append(fit.covariance)
        upright = refine(off(truth, view), seen, LOGGED, READOUT_S, PRIORS, truth[:3, :3].T @ DOWN)
        assert np.trace(upright.covariance[:3, :3]) < np.trace(fit.covariance[:3, :3])
    for squares in normalised_squares(np.array(errors), np.array(covariances)):
        assert 0.85 <= (squares < chi2.ppf(0.95, 3)).mean() <= 1.0
        assert 1.2 < np.median(squares) < 4.5  # chi2 of 3: 2.37


def test_an_outlier_weighs_little() -> None:
    views = walk(3, moving=False)
    seen = observed(views, 1, 100, noise_px=0.3)
    wrong = seen.ideal.copy()
    wrong[0] += 0.05
    there, shifted = (
        refine(views.map_T_cam[1], Observed(seen.px, ideal, seen.xyz), LOGGED, 0.0, PRIORS).map_T_cam
        for ideal in (seen.ideal, wrong)
    )
    assert position_error(there, shifted) < 0.003


def test_pose_error_is_by_which_the_truth_differs() -> None:
    truth, estimate = off(np.eye(4), 1), off(np.eye(4), 2)
    error = pose_error(estimate, truth)
    turned = Rotation.from_rotvec(error[:3]).as_matrix() @ estimate[:3, :3]
    np.testing.assert_allclose(make_pose(turned, estimate[:3, 3] + error[3:]), truth, atol=1e-12)
