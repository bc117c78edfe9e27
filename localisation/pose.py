"""The pose of one image from points that it sees: RANSAC, and a refinement that knows what phones do.

What a query doesn't know of its camera is estimated with it, held by priors from the training frames: how it turned and
moved while its rows were read out, and by which factor its focal length deviates from the logged one.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, make_pose, skew
from groundwalk.geometry.robust import CAUCHY_WIDTH
from groundwalk.localisation.frames import row_times

_CONVERGED = 5e-5  # rad, m
_UNKNOWNS = 13
NO_VERTICAL = float(np.pi)
"""The `gravity_sd` of a map whose +y isn't up."""


@dataclass(frozen=True)
class Priors:
    """One sigma of what a query's camera does: angular velocity, rad/s, velocity, m/s, relative focal length; of
    gravity, rad (`NO_VERTICAL`: it says nothing of the map's axes); the least that keypoints are taken to be off by,
    px; and of what training frames measured of points, rad."""

    angular_sd: float
    velocity_sd: float
    focal_sd: float
    gravity_sd: float
    pixel_sd: float
    point_sd: float = 0.0


@dataclass(frozen=True)
class Observed:
    """M keypoints px (M, 2), their ideal image points (M, 2) at unit focal length, and the points xyz (M, 3) in the
    map with their covariances (M, 3, 3), m^2, or None where they are taken to be exact."""

    px: Array
    ideal: Array
    xyz: Array
    covariance: Array | None = None


@dataclass(frozen=True)
class Fit:
    """A pose map_T_cam (4, 4) with the covariance (6, 6) of (rotation, position) in the map's axes, true rotation =
    exp(rotation) @ map_R_cam, for keypoints' errors as they scatter; residuals (M,), px, and one sigma that they
    should have (M,), by the keypoints' scatter and the points' covariances; factor of the focal length; angular
    velocity (3,), rad/s, and velocity (3,), m/s, in the camera's axes."""

    map_T_cam: Array
    covariance: Array
    residual_px: Array
    expected_px: Array
    focal_factor: float
    angular: Array
    velocity: Array


def ransac(
    ideal_M2: Array, xyz_M3: Array, max_error: float, trials: int, seed: int
) -> tuple[Array, NDArray[np.bool_]] | None:
    """A pose map_T_cam and its inliers (M,) by OpenCV's USAC with local optimisation (Raguram et al., "USAC", PAMI
    2013; Chum et al., "Locally optimized RANSAC", DAGM 2003), or None.

    Ideal image points (M, 2) are at unit focal length, and so is `max_error`. The rolling shutter is left out here, so
    that it has to be wide.
    """
    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.threshold = 0.9999, trials, max_error
    params.score, params.sampler = cv2.SCORE_METHOD_MSAC, cv2.SAMPLING_UNIFORM
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_INNER_LO, 10, 14
    params.randomGeneratorState = seed
    params.final_polisher = cv2.NONE_POLISHER
    try:
        solution = cv2.solvePnPRansac(xyz_M3, ideal_M2, np.eye(3), None, params=params)
    except cv2.error:  # it has no other way to say that no sample gave a pose
        return None
    if not solution[0]:
        return None
    cam_R_map, cam_t = Rotation.from_rotvec(np.ravel(solution[2])).as_matrix(), np.ravel(solution[3])
    cam = xyz_M3 @ cam_R_map.T + cam_t
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(cam[:, :2] / cam[:, 2:] - ideal_M2, axis=1)
    return make_pose(cam_R_map.T, -cam_R_map.T @ cam_t), (cam[:, 2] > 0) & (error <= max_error)


def refine(
    map_T_cam: Array,
    seen: Observed,
    camera: Camera,
    readout_s: float,
    priors: Priors,
    gravity: Array | None = None,
    iterations: int = 8,
) -> Fit:
    """The pose of the middle row from which points are seen, by Gauss-Newton with Cauchy weights. A residual weighs by
    how the keypoints scatter and how sure its point is.

    `gravity` is a unit vector (3,) in the camera, or None. Unknowns: rotation and position in the camera's axes,
    angular velocity, velocity, log of the focal length's factor.
    """
    focal = (camera.fx + camera.fy) / 2
    time_s = row_times(seen.px, camera, readout_s)
    information = np.zeros(_UNKNOWNS)
    information[6:9], information[9:12] = priors.angular_sd**-2, priors.velocity_sd**-2
    information[12] = priors.focal_sd**-2
    rotation, position, rest = map_T_cam[:3, :3].copy(), map_T_cam[:3, 3].copy(), np.zeros(7)
    of_points = np.zeros((len(seen.xyz), 3))  # covariances of points in the image, px^2: xx, xy, yy
    if seen.covariance is not None:
        slope = _linear(rotation, position, rest, seen, time_s, focal)[1][:, :, 3:6] @ rotation.T
        image = slope @ seen.covariance @ slope.transpose(0, 2, 1)
        of_points = np.stack([image[:, 0, 0], image[:, 0, 1], image[:, 1, 1]], axis=1)
    variance = (of_points[:, 0] + of_points[:, 2]) / 2
    sure = variance <= _median(variance)
    sure_variance = _median(variance[sure])
    for _ in range(iterations):
        residual, jacobian = _linear(rotation, position, rest, seen, time_s, focal)
        # Keypoints' scatter, by the half of the points that are surest.
        scatter = _median(np.sum(residual[sure] ** 2, axis=1)) / (2 * np.log(2)) - sure_variance
        scale = np.sqrt(max(priors.pixel_sd**2, scatter))
        white, rows = _whitened(residual, jacobian, of_points + scale**2 * np.array([1, 0, 1]))
        weight = np.repeat(1 / (1 + np.sum(white**2, axis=1) / CAUCHY_WIDTH**2), 2)
        rows = rows.reshape(-1, _UNKNOWNS)
        weighted = rows * weight[:, None]
        hessian = weighted.T @ rows + np.diag(information)
        gradient = weighted.T @ white.ravel()
        gradient[6:] += information[6:] * rest
        if gravity is not None:
            # (gravity - its prediction) / sd
            predicted = rotation.T @ [0, -1.0, 0]
            by_turn, certainty = -skew(predicted), 1 / priors.gravity_sd**2
            hessian[:3, :3] += certainty * by_turn.T @ by_turn
            gradient[:3] += certainty * by_turn.T @ (gravity - predicted)
        step = -np.linalg.solve(hessian + 1e-9 * np.eye(_UNKNOWNS), gradient)
        position = position + rotation @ step[3:6]
        rotation = rotation @ _turn(step[:3])
        rest = rest + step[6:]
        if np.abs(step[:6]).max() < _CONVERGED:
            break
    residual, _ = _linear(rotation, position, rest, seen, time_s, focal)
    to_map = np.zeros((6, 6))
    to_map[:3, :3] = to_map[3:, 3:] = rotation
    covariance, focal_factor = to_map @ np.linalg.inv(hessian)[:6, :6] @ to_map.T, float(np.exp(rest[6]))
    residual_px, expected_px = np.linalg.norm(residual, axis=1), np.sqrt(scale**2 + variance)
    pose = make_pose(rotation, position)
    return Fit(pose, covariance, residual_px, expected_px, focal_factor, rest[:3], rest[3:6])


def _turn(vector: Array) -> Array:
    """The rotation (3, 3) by a rotation vector (3,), by Rodrigues' formula; scipy's takes longer than all else here."""
    angle = max(float(np.sqrt(vector @ vector)), 1e-12)
    across = skew(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across)


def _median(values: Array) -> float:
    """The upper median, in a tenth of the time of numpy's."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _whitened(residual: Array, jacobian: Array, covariance_M3: Array) -> tuple[Array, Array]:
    """Residuals (M, 2) and derivatives (M, 2, U) by the inverse Cholesky factors of covariances xx, xy, yy (M, 3)."""
    xx, xy, yy = covariance_M3.T
    a = 1 / np.sqrt(xx)
    b = xy * a
    c = 1 / np.sqrt(yy - b * b)
    white, rows = np.empty_like(residual), np.empty_like(jacobian)
    white[:, 0] = residual[:, 0] * a
    white[:, 1] = (residual[:, 1] - b * white[:, 0]) * c
    rows[:, 0] = jacobian[:, 0] * a[:, None]
    rows[:, 1] = (jacobian[:, 1] - b[:, None] * rows[:, 0]) * c[:, None]
    return white, rows


def _linear(
    rotation: Array, position: Array, rest: Array, seen: Observed, time_s: Array, focal: float
) -> tuple[Array, Array]:
    """Residuals (M, 2), px, and their derivatives (M, 2, 13)."""
    still = (seen.xyz - position) @ rotation
    angular, velocity, factor = rest[:3], rest[3:6], np.exp(rest[6])
    cam = still - time_s[:, None] * (velocity + still @ skew(angular).T)
    x, y, depth = cam.T
    depth = np.maximum(depth, 1e-3)
    u, v, per_depth, pixels = x / depth, y / depth, focal * factor / depth, focal * factor
    residual = np.empty((len(cam), 2))
    residual[:, 0], residual[:, 1] = pixels * u - focal * seen.ideal[:, 0], pixels * v - focal * seen.ideal[:, 1]
    jacobian = np.empty((len(cam), 2, _UNKNOWNS))
    # A small turn d of the camera moves its points by cam x d.
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = pixels * u * v, -pixels * (1 + u * u), pixels * v
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = pixels * (1 + v * v), -pixels * u * v, -pixels * u
    jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 0, 5] = -per_depth, 0, per_depth * u
    jacobian[:, 1, 3], jacobian[:, 1, 4], jacobian[:, 1, 5] = 0, -per_depth, per_depth * v
    jacobian[:, :, 6:12] = jacobian[:, :, :6] * time_s[:, None, None]
    jacobian[:, 0, 12], jacobian[:, 1, 12] = pixels * u, pixels * v
    return residual, jacobian
