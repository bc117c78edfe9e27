"""How far ground truth may be off: covariance in the map, and the quality class that follows from it.

A pose's error is (rotation, position), both in the axes of the frame it is given in: true rotation =
exp(rotation) @ R, true position = t + position.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from geometry.fits import Sim3
from geometry.poses import Array


@dataclass(frozen=True)
class SharedSd:
    """One sigma of what all poses of a map share: relative scale, tilt of the vertical in radians per axis, and a turn
    of all cameras about their own x and y axes, radians each."""

    scale: float
    tilt: float
    camera: float = 0.0


@dataclass(frozen=True)
class QualityLimits:
    """What a frame must keep for a class: sigmas of SfM's own part, image points seen, mean reprojection angle."""

    position_sd_m: float
    rotation_sd_deg: float
    observations: int
    reprojection_deg: float


def covariance_in_map(covariance_sfm: Array, map_S_sfm: Sim3) -> Array:
    """Covariances (N, 6, 6) of poses in SfM's frame and units, in the map's frame and metres."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = map_S_sfm.rotation
    jacobian[3:, 3:] = map_S_sfm.scale * map_S_sfm.rotation
    return jacobian @ covariance_sfm @ jacobian.T


def shared_covariance(map_T_cam: Array, anchor: Array, sd: SharedSd) -> Array:
    """Covariances (N, 6, 6) of poses (N, 4, 4) from what all of them share.

    A wrong scale or tilt turns and stretches the map about a place that stays; `anchor` (3,) is that place. What all
    keypoints are off by in common turns each camera about its own axes, all alike. Origin and heading of the map are
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
    """Sigma along the least certain axis of covariances (N, 6, 6): metres and radians (N,); NaN where NaN."""
    sds = np.full((2, len(covariance)), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    for row, block in ((0, slice(3, 6)), (1, slice(0, 3))):
        largest = np.linalg.eigvalsh(covariance[known, block, block])[:, -1]
        sds[row, known] = np.sqrt(np.maximum(largest, 0.0))
    return sds[0], sds[1]


def quality_classes(frames: pd.DataFrame, limits: dict[str, QualityLimits]) -> np.ndarray:
    """A, B or C (N,) for frames with ground truth: the first class all of whose limits hold; C has none.

    `frames` has position_sd_m and rotation_sd_deg (NaN where SfM gives no covariance: at most B), observations,
    reprojection_deg, and checked (bool: the frame took part in the comparison with VIO, and its focal length is in no
    doubt; otherwise C).
    """
    quality = np.full(len(frames), "C", dtype=object)
    for name in ("B", "A"):
        limit = limits[name]
        good = frames["observations"] >= limit.observations
        good &= frames["reprojection_deg"] <= limit.reprojection_deg
        sds_good = (frames["position_sd_m"] <= limit.position_sd_m) & (
            frames["rotation_sd_deg"] <= limit.rotation_sd_deg
        )
        if name == "B":
            sds_good |= frames["position_sd_m"].isna()
        quality[(good & sds_good & frames["checked"]).to_numpy(bool)] = name
    return quality
