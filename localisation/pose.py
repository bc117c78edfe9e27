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
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.localisation.frames import row_times

_ITERATIONS = 12
_CONVERGED = 1e-7
_MIN_POINTS = 6
_UNKNOWNS = 13


@dataclass(frozen=True)
class Priors:
    """One sigma of what a query's camera does: angular velocity rad/s, velocity m/s, relative focal length; and the
    errors of keypoints, px, beyond which least squares isn't believed."""

    angular_sd: float
    velocity_sd: float
    focal_sd: float
    pixel_sd: float


@dataclass(frozen=True)
class Fit:
    """A pose map_T_cam (4, 4) with the covariance (6, 6) of (rotation, position) in the map's axes, true rotation =
    exp(rotation) @ map_R_cam, for keypoints' errors as they scatter; residuals (M,), px, and one sigma of them; factor of
    the focal length; angular velocity (3,), rad/s, and velocity (3,), m/s, in the camera's axes."""

    map_T_cam: Array
    covariance: Array
    residual_px: Array
    pixel_sd: float
    focal_factor: float
    angular: Array
    velocity: Array


def ransac(
    px_M2: Array, xyz_M3: Array, camera: Camera, max_px: float, trials: int, seed: int
) -> tuple[Array, NDArray[np.bool_]] | None:
    """A pose map_T_cam and its inliers (M,) by OpenCV's USAC (Barath et al., "MAGSAC++", CVPR 2020; LO-RANSAC), or None.

    The rolling shutter is left out here, so `max_px` is wide.
    """
    ideal = camera.unproject(px_M2)
    seen = np.flatnonzero(np.isfinite(ideal).all(axis=1))
    if len(seen) < _MIN_POINTS:
        return None
    focal = (camera.fx + camera.fy) / 2
    params = cv2.UsacParams()
    params.confidence, params.maxIterations = 0.9999, trials
    params.threshold = max_px / focal
    params.score = cv2.SCORE_METHOD_MSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.loMethod, params.loIterations, params.loSampleSize = cv2.LOCAL_OPTIM_INNER_LO, 10, 14
    params.randomGeneratorState = seed
    params.final_polisher = cv2.NONE_POLISHER
    try:
        found = cv2.solvePnPRansac(xyz_M3[seen], ideal[seen], np.eye(3), None, params=params)
    except cv2.error:
        return None
    if not found[0] or found[-1] is None:
        return None
    turn, move = found[2], found[3]
    cam_R_map = Rotation.from_rotvec(np.ravel(turn)).as_matrix()
    cam = xyz_M3 @ cam_R_map.T + np.ravel(move)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = focal * np.linalg.norm(cam[:, :2] / cam[:, 2:] - ideal, axis=1)
    inliers = (cam[:, 2] > 0) & (error <= max_px)
    return make_pose(cam_R_map.T, -cam_R_map.T @ np.ravel(move)), inliers


def refine(
    map_T_cam: Array, px_M2: Array, xyz_M3: Array, camera: Camera, readout_s: float, priors: Priors, sd_M: Array | None = None
) -> Fit:
    """The pose of the middle row of which points (M, 3) are seen at pixels (M, 2), by Gauss-Newton with Cauchy weights.

    `sd_M` (M,) are the observations' relative standard deviations. Unknowns: rotation and position in the camera's
    axes, angular velocity, velocity, log of the focal length's factor.
    """
    focal = (camera.fx + camera.fy) / 2
    time_s = row_times(px_M2, camera.height, readout_s)
    ideal = camera.unproject(px_M2)
    root = 1 / (np.ones(len(px_M2)) if sd_M is None else sd_M)
    prior = 1 / np.r_[np.full(6, np.inf), np.full(3, priors.angular_sd), np.full(3, priors.velocity_sd), priors.focal_sd]
    rotation, position, rest = map_T_cam[:3, :3].copy(), map_T_cam[:3, 3].copy(), np.zeros(7)
    for _ in range(_ITERATIONS):
        residual, jacobian = _linear(rotation, position, rest, xyz_M3, ideal, time_s, focal)
        scale = max(priors.pixel_sd, 1.4826 * float(np.median(np.abs(residual) * root[:, None])))
        weight = root**2 / (1 + np.sum(residual**2, axis=1) * root**2 / (2.385 * scale) ** 2) / scale**2
        weighted = jacobian * weight[:, None, None]
        hessian = np.einsum("mki,mkj->ij", weighted, jacobian) + np.diag(prior**2)
        gradient = np.einsum("mki,mk->i", weighted, residual) + prior**2 * np.r_[np.zeros(6), rest]
        step = -np.linalg.solve(hessian, gradient)
        position = position + rotation @ step[3:6]
        rotation = rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
        rest = rest + step[6:]
        if np.abs(step[:6]).max() < _CONVERGED:
            break
    residual, jacobian = _linear(rotation, position, rest, xyz_M3, ideal, time_s, focal)
    covariance = np.linalg.inv(hessian)[:6, :6]
    to_map = np.kron(np.eye(2), rotation)
    return Fit(
        make_pose(rotation, position),
        to_map @ covariance @ to_map.T,
        np.linalg.norm(residual, axis=1),
        scale,
        float(np.exp(rest[6])),
        rest[:3],
        rest[3:6],
    )


def _linear(
    rotation: Array, position: Array, rest: Array, xyz_M3: Array, ideal: Array, time_s: Array, focal: float
) -> tuple[Array, Array]:
    """Residuals (M, 2), px, and their derivatives (M, 2, 13); infinite residuals where a point is behind the camera."""
    still = (xyz_M3 - position) @ rotation
    angular, velocity, factor = rest[:3], rest[3:6], np.exp(rest[6])
    cam = still - time_s[:, None] * (velocity + np.cross(angular, still))
    depth = np.where(cam[:, 2] > 1e-6, cam[:, 2], 1e-6)
    at = cam[:, :2] / depth[:, None]
    residual = focal * (at * factor - ideal)
    by_cam = np.zeros((len(cam), 2, 3))
    by_cam[:, 0, 0] = by_cam[:, 1, 1] = focal * factor / depth
    by_cam[:, :, 2] = -focal * factor * at / depth[:, None]
    jacobian = np.empty((len(cam), 2, _UNKNOWNS))
    # A small turn d of the camera moves its points by cam x d.
    jacobian[:, :, :3] = np.cross(by_cam, cam[:, None])
    jacobian[:, :, 3:6] = -by_cam
    jacobian[:, :, 6:9] = jacobian[:, :, :3] * time_s[:, None, None]
    jacobian[:, :, 9:12] = -by_cam * time_s[:, None, None]
    jacobian[:, :, 12] = focal * at * factor
    return residual, jacobian
