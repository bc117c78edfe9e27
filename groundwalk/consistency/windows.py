"""Motion of a model against VIO: rigid fits of VIO over windows of its path.

Over a whole walk VIO's drift would bend the path.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.decisions import beyond
from groundwalk.consistency.trajectories import TrajectoryPair, path_windows
from groundwalk.consistency.vio_drift import DRIFT_M, DRIFT_M_PER_M, drift_rad
from groundwalk.geometry.fits import ROBUST_TOLERANCE, fit_poses, fit_robust, pose_residuals
from groundwalk.geometry.poses import Array

WINDOW_M = 10.0
"""Short windows suffer from noise of single positions, long ones from bending by VIO's drift."""

_MIN_FRAMES = 3
# Over a short window the constant part of VIO's drift is more than the path's extent: there it grows with the path,
# from this fraction of itself on.
_MIN_CONSTANT_FRACTION = 0.2


@dataclass(frozen=True)
class PoseSd:
    """How position counts against rotation in fits of VIO to the map: metres and radians."""

    position_m: float
    rotation: float


POSE_SD = PoseSd(0.01, float(np.radians(1.0)))


@dataclass(frozen=True)
class WindowResiduals:
    """A window after VIO was fitted to it: indices (n,) of its frames, their residuals (metres, radians), the limits,
    and the frames' standard errors in the model (0 where not known)."""

    inside: NDArray[np.intp]
    position_m: Array
    rotation: Array
    limit_m: float
    limit_rotation: float
    position_sd_m: Array
    rotation_sd: Array

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(n,) frames that are beyond a limit."""
        in_position = beyond(self.position_m, self.position_sd_m, self.limit_m)
        return in_position | beyond(self.rotation, self.rotation_sd, self.limit_rotation)


def fit_rigid(
    map_T_cam: Array, vio_T_cam: Array, sd: PoseSd, *, yaw_only: bool = False, tolerance: float = ROBUST_TOLERANCE
) -> tuple[Array, Array, Array]:
    """Robust map_T_vio (4, 4) from poses (N, 4, 4) of the same frames, and its residuals: metres and radians (N,)."""

    def residuals(map_T_vio: Array) -> Array:
        metres, radians = pose_residuals(map_T_cam, vio_T_cam, map_T_vio)
        return np.hypot(metres / sd.position_m, radians / sd.rotation)

    map_T_vio, _ = fit_robust(
        lambda w: fit_poses(
            map_T_cam, vio_T_cam, w, position_sd_m=sd.position_m, rotation_sd=sd.rotation, yaw_only=yaw_only
        ),
        residuals,
        len(map_T_cam),
        floor=1.0,
        tolerance=tolerance,
    )
    return map_T_vio, *pose_residuals(map_T_cam, vio_T_cam, map_T_vio)


def compare_windows(
    metric: TrajectoryPair, tolerance: float = ROBUST_TOLERANCE, frame_sd: tuple[Array, Array] | None = None
) -> list[WindowResiduals]:
    """The windows of a trajectory whose poses by SfM are at metric scale, each with VIO rigidly fitted to it.

    The fit follows the majority of a window's frames, so that single wrong poses stand out. A window needs 3 frames.
    `frame_sd`: the frames' standard errors in the model, metres and radians (n,).
    """
    metric_T_cam, vio_T_cam, travelled_m = metric
    if len(vio_T_cam) < _MIN_FRAMES:
        return []
    position_sd_m, rotation_sd = np.zeros((2, len(vio_T_cam))) if frame_sd is None else frame_sd
    compared = []
    for inside in path_windows(travelled_m, WINDOW_M):
        _, metres, radians = fit_rigid(metric_T_cam[inside], vio_T_cam[inside], POSE_SD, tolerance=tolerance)
        length_m = travelled_m[inside[-1]] - travelled_m[inside[0]]
        growing_m = DRIFT_M_PER_M * length_m
        limit_m = float(growing_m + min(DRIFT_M, max(_MIN_CONSTANT_FRACTION * DRIFT_M, growing_m)))
        limits = limit_m, float(drift_rad(length_m))
        compared.append(WindowResiduals(inside, metres, radians, *limits, position_sd_m[inside], rotation_sd[inside]))
    return compared
