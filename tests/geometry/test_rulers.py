"""A ruler's scale from known poses: exact without noise, honest with it, and what can be wrong with a board."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import inverse, make_pose, transform
from groundwalk.geometry.rulers import Corners, Observations, RulerFit, measure

FOCAL_PX = 1400.0
SQUARE_M = 0.022
GAUGE = Sim3(0.4, Rotation.from_euler("xyz", [0.3, 1.0, -0.5]).as_matrix(), np.array([2.0, -1.0, 0.5]))


def board(columns: int = 10, rows: int = 7) -> Corners:
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    xyz_m = SQUARE_M * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return Corners(xyz_m, np.zeros(x.size, dtype=int))


def tags(count: int = 4, side_m: float = 0.08) -> Corners:
    square = side_m * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    return Corners(np.tile(square, (count, 1)), np.repeat(np.arange(count), 4))


def poses_around(frames: int, rng: np.random.Generator, distance_m: float = 0.6) -> np.ndarray:
    """Cameras (F, 4, 4) in the board's axes, in front of it (z < 0), looking at its middle."""
    at = np.column_stack([rng.uniform(-0.5, 0.7, frames), rng.uniform(-0.4, 0.5, frames), np.zeros(frames)])
    at[:, 2] = -np.sqrt(np.maximum(distance_m**2 - np.sum((at[:, :2] - 0.1) ** 2, axis=1), 0.1))
    forward = np.array([0.1, 0.07, 0.0]) - at
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.1, -1.0, 0.2])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return make_pose(np.stack([right, np.cross(forward, right), forward], axis=2), at)


def observe(xyz: np.ndarray, poses: np.ndarray, rng: np.random.Generator, pixel_sd: float) -> Observations:
    """Every corner (K, 3) in every frame."""
    corner, frame = (index.ravel() for index in np.meshgrid(np.arange(len(xyz)), np.arange(len(poses))))
    seen = transform(inverse(poses)[frame], xyz[corner])
    xy = seen[:, :2] / seen[:, 2:] + rng.normal(0, pixel_sd / FOCAL_PX, (len(seen), 2))
    return Observations(corner, frame, xy, np.full(len(corner), FOCAL_PX))


def fitted(
    corners: Corners, observations: Observations, poses: np.ndarray, covariance: np.ndarray | None = None
) -> RulerFit:
    if covariance is None:
        covariance = np.zeros((len(poses), 6, 6))
    return measure(corners, observations, poses, covariance, min_pixel_sd=0.02)


def test_without_noise_scale_and_corners_are_exact_in_any_gauge() -> None:
    rng = np.random.default_rng(0)
    corners, poses = board(), poses_around(6, rng)
    observations = observe(corners.xyz_m, poses, rng, 0.0)
    fit = fitted(corners, observations, GAUGE.poses(poses))
    assert np.exp(fit.log_scale) == pytest.approx(0.4, rel=1e-9)
    np.testing.assert_allclose(fit.xyz, GAUGE.points(corners.xyz_m), atol=1e-9)
    assert fit.corner_rms_m < 1e-9 and fit.flatness_m < 1e-9 and fit.reprojection_px < 1e-6
    assert not fit.mirrored and fit.inlier.all() and len(fit.frames) == 6


@pytest.mark.parametrize("corners", [board(6, 4), tags()], ids=["board", "tags"])
@pytest.mark.parametrize(
    ("pose_sd_m", "pose_sd"),
    [pytest.param(0.0, 0.0, id="pixels", marks=pytest.mark.slow), pytest.param(0.002, 0.001, id="poses")],
)
def test_the_standard_error_holds_over_noise_draws(corners: Corners, pose_sd_m: float, pose_sd: float) -> None:
    """Errors over 24 draws of pixel and pose noise, in sigmas: a standard deviation near 1, 95 % within 1.96."""
    sigmas = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        poses = poses_around(10, rng)
        placed = (
            corners.xyz_m
            + 0.03 * (corners.part % 2)[:, None] * [4, 0, 0]
            + 0.1 * (corners.part // 2)[:, None] * [0, 1, 0]
        )
        observations = observe(placed, poses, rng, 0.3)
        turns = Rotation.from_rotvec(rng.normal(0, pose_sd, (len(poses), 3))).as_matrix()
        noisy = make_pose(turns @ poses[:, :3, :3], poses[:, :3, 3] + rng.normal(0, pose_sd_m, (len(poses), 3)))
        covariance = np.tile(np.diag([pose_sd**2] * 3 + [pose_sd_m**2] * 3), (len(poses), 1, 1))
        fit = fitted(corners, observations, noisy, covariance)
        sigmas.append(fit.log_scale / fit.sd)
    assert 0.7 < np.std(sigmas) < 1.25, np.std(sigmas)
    assert np.mean(np.abs(sigmas) < 1.96) >= 0.9
    assert abs(np.mean(sigmas)) < 0.3


def test_wrong_detections_and_a_wrong_frame_take_no_part() -> None:
    rng = np.random.default_rng(3)
    corners, poses = board(), poses_around(12, rng)
    observations = observe(corners.xyz_m, poses, rng, 0.2)
    wrong = rng.random(len(observations.corner)) < 0.1
    observations.xy[wrong] += rng.normal(0, 100 / FOCAL_PX, (wrong.sum(), 2))
    moved = poses.copy()
    moved[5, :3, 3] += [0.05, 0.0, 0.02]
    fit = fitted(corners, observations, moved)
    assert abs(fit.log_scale) < 4 * fit.sd < 0.004
    assert not fit.inlier[observations.frame == 5].any()
    assert fit.inlier[wrong].mean() < 0.05 and fit.inlier[~wrong & (observations.frame != 5)].mean() > 0.98


def test_a_mirrored_board_is_told_by_its_front() -> None:
    rng = np.random.default_rng(4)
    corners, poses = board(), poses_around(8, rng)
    printed = corners.xyz_m * [-1, 1, 1]
    assert fitted(corners, observe(printed, poses, rng, 0.2), poses).mirrored


def test_corners_seen_once_measure_nothing() -> None:
    rng = np.random.default_rng(7)
    corners, poses = board(), poses_around(1, rng)
    with pytest.raises(GeometryError, match="two frames"):
        fitted(corners, observe(corners.xyz_m, poses, rng, 0.0), poses)
