"""How far ground truth may be off: covariances in the map.

A pose's error is (rotation, position), both in the axes of the frame it is given in: true rotation =
exp(rotation) @ R, true position = t + position.
"""

from dataclasses import dataclass

import numpy as np

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array


@dataclass(frozen=True)
class SharedSd:
    """Standard errors that all poses of a map share: relative scale, tilt of the vertical in radians per axis, and a
    turn of each camera about its x and y axes, radians each."""

    scale: float
    tilt: float
    camera: float = 0.0


def covariance_in_map(covariance_sfm: Array, map_S_sfm: Sim3) -> Array:
    """Covariances (N, 6, 6) of poses in SfM's frame and units, in the map's frame and metres."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = map_S_sfm.rotation
    jacobian[3:, 3:] = map_S_sfm.scale * map_S_sfm.rotation
    return jacobian @ covariance_sfm @ jacobian.T


def shared_covariance(map_T_cam: Array, anchor: Array, sd: SharedSd) -> Array:
    """Covariances (N, 6, 6) of poses (N, 4, 4) from what all of them share.

    A wrong scale or tilt turns and stretches the map about a place that stays; `anchor` (3,) is that place. What all
    keypoints are off by in common turns each camera about its axes, all alike. Origin and heading of the map are
    free, so they have no error.
    """
    map_T_cam = np.asarray(map_T_cam, dtype=float)
    arm = map_T_cam[:, :3, 3] - anchor
    jacobian = np.zeros((len(arm), 6, 5))
    jacobian[:, 3:, 0] = arm
    for column, axis in ((1, [1.0, 0.0, 0.0]), (2, [0.0, 0.0, 1.0])):
        jacobian[:, :3, column] = axis
        jacobian[:, 3:, column] = np.cross(axis, arm)
    jacobian[:, :3, 3:] = map_T_cam[:, :3, :2]
    variance = np.array([sd.scale, sd.tilt, sd.tilt, sd.camera, sd.camera]) ** 2
    return np.einsum("nij,j,nkj->nik", jacobian, variance, jacobian)


def largest_sd(covariance: Array) -> tuple[Array, Array]:
    """Standard error along the least certain axis of covariances (N, 6, 6): metres and radians (N,); NaN where NaN."""
    sds = np.full((2, len(covariance)), np.nan)
    is_finite = np.isfinite(covariance).all(axis=(1, 2))
    for row, block in ((0, slice(3, 6)), (1, slice(0, 3))):
        largest = np.linalg.eigvalsh(covariance[is_finite, block, block])[:, -1]
        sds[row, is_finite] = np.sqrt(np.maximum(largest, 0.0))
    return sds[0], sds[1]
