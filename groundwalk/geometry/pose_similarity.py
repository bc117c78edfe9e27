"""The robust similarity between two sets of poses of the same cameras, positions and rotations together."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3, fit_poses, fit_robust, fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array

# In the fit, positions weigh as if they were off by this fraction of the cameras' extent and rotations by this angle:
# free of units, a straight path gets its roll from the rotations, and elsewhere cameras that are all turned alike, as
# by a wrong principal point, hardly turn the fit. Outliers are those beyond a tighter angle.
_POSITION_FRACTION, _ROTATION_SD, _ROTATION_RESIDUAL_SD = 0.01, float(np.radians(5.0)), float(np.radians(1.0))
# Smaller residuals, in these sigmas, count alike: a tenth of a per cent of the extent.
_RESIDUAL_FLOOR = 0.1
_MIN_POSES = 3
_UNKNOWNS = 7
# Cameras in one place have no scale: positions apart by rounding alone.
_MIN_EXTENT = 1e-9


@dataclass(frozen=True)
class PoseSimilarity:
    """The a_S_b that brings poses of b onto a's, and the residuals: distances in a's unit and radians (N,).

    `scale_sd` is relative, `turn_sd` in radians about the least certain axis: standard errors of the fit by the scatter
    of the residuals, independent from pose to pose.
    """

    a_S_b: Sim3
    position: Array
    rotation: Array
    scale_sd: float
    turn_sd: float


def fit_similar_poses(a_T_cam: ArrayLike, b_T_cam: ArrayLike, *, with_scale: bool = True) -> PoseSimilarity:
    """The robust similarity, or rigid transform, a_S_b from camera poses (N, 4, 4) of both; a and b may have any unit.

    Raises GeometryError for fewer than 3 poses, and, with scale, for cameras that are all in one place.
    """
    a, b = np.asarray(a_T_cam, dtype=float), np.asarray(b_T_cam, dtype=float)
    if len(a) < _MIN_POSES:
        raise GeometryError(f"{len(a)} poses are too few for a similarity, which needs {_MIN_POSES}")
    xyz_a, xyz_b = a[:, :3, 3], b[:, :3, 3]
    radius = float(np.sqrt(np.mean(np.sum((xyz_a - xyz_a.mean(axis=0)) ** 2, axis=1))))
    if not radius > _MIN_EXTENT * float(np.abs(xyz_a).max()):
        raise GeometryError(f"{len(a)} cameras in one place determine no scale")
    position_sd = _POSITION_FRACTION * radius

    def fit(weights: Array) -> Sim3:
        scale = fit_sim3(xyz_a, xyz_b, weights, line_ok=True).scale if with_scale else 1.0
        scaled = Sim3(scale, np.eye(3), np.zeros(3)).poses(b)
        a_T_scaled = fit_poses(a, scaled, weights, position_sd_m=position_sd, rotation_sd=_ROTATION_SD)
        return Sim3(scale, a_T_scaled[:3, :3], a_T_scaled[:3, 3])

    def normalised(a_S_b: Sim3) -> Array:
        position, rotation = pose_residuals(a, a_S_b.poses(b), np.eye(4))
        return np.hypot(position / position_sd, rotation / _ROTATION_RESIDUAL_SD)

    a_S_b, weights = fit_robust(fit, normalised, len(a), floor=_RESIDUAL_FLOOR)
    position, rotation = pose_residuals(a, a_S_b.poses(b), np.eye(4))
    count = float(weights.sum())
    # Positions give nearly all of the seven unknowns.
    variance = float(weights @ position**2) / max(3 * count - _UNKNOWNS, 1.0)
    of_rotations = float(weights @ rotation**2) / (3 * count)
    # What the fit knows of a turn about each axis of the positions, by these and by rotations, as it weighs the two.
    arm = xyz_a - np.average(xyz_a, axis=0, weights=weights)
    spread = np.linalg.eigvalsh((weights * arm.T) @ arm)
    known, by_rotations = np.maximum(spread.sum() - spread, 0) / position_sd**2, count / _ROTATION_SD**2
    spoiled = known * variance / position_sd**2 + by_rotations * of_rotations / _ROTATION_SD**2
    turn = float(np.sqrt(spoiled / (known + by_rotations) ** 2).max())
    scale_sd = float(np.sqrt(variance / count)) / radius if with_scale else 0.0
    return PoseSimilarity(a_S_b, position, rotation, scale_sd, turn)
