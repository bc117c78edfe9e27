"""Do SfM and VIO tell the same story, window by window? Where they don't, the model is wrong or VIO jumped."""

from dataclasses import dataclass

import numpy as np

from alignment.segments import Segment, windows
from geometry.fits import Sim3, fit_poses, fit_robust, pose_residuals
from geometry.poses import Array


@dataclass(frozen=True)
class PoseSd:
    """How position counts against rotation in fits of VIO to the map: metres and radians."""

    position_m: float
    rotation: float


@dataclass(frozen=True)
class Allowance:
    """What VIO may drift by within a window: a floor and a share of the distance that it travelled there."""

    position_m: float
    position_per_m: float
    rotation: float
    rotation_per_m: float

    def limits(self, travelled_m: float) -> tuple[float, float]:
        """Metres and radians allowed in a window of this length."""
        return (
            self.position_m + self.position_per_m * travelled_m,
            self.rotation + self.rotation_per_m * travelled_m,
        )


@dataclass(frozen=True)
class Window:
    """A window of a segment: indices (n,) of its frames, their residuals (metres, radians) and the limits."""

    segment: Segment
    inside: np.ndarray
    position_m: Array
    rotation: Array
    limit_m: float
    limit_rotation: float

    @property
    def wrong(self) -> np.ndarray:
        """(n,) frames beyond a limit."""
        return (self.position_m > self.limit_m) | (self.rotation > self.limit_rotation)


def fit_rigid(map_T_cam: Array, vio_T_cam: Array, sd: PoseSd, *, yaw_only: bool = False) -> tuple[Array, Array, Array]:
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
    )
    return map_T_vio, *pose_residuals(map_T_cam, vio_T_cam, map_T_vio)


def compare(segment: Segment, metric_S_sfm: Sim3, window_m: float, allowance: Allowance, sd: PoseSd) -> list[Window]:
    """The windows of a segment, each with VIO rigidly fitted to SfM at the common metric scale.

    The fit follows the majority of a window's frames, so that single wrong poses stand out. A window needs 3 frames.
    """
    known = np.flatnonzero(segment.both)
    if len(known) < 3:
        return []
    subset = segment.where(segment.both)
    metric_T_cam = metric_S_sfm.poses(subset.sfm_T_cam)
    travelled = subset.travelled_m
    compared = []
    for inside in windows(subset, window_m):
        if len(inside) < 3:
            continue
        _, metres, radians = fit_rigid(metric_T_cam[inside], subset.vio_T_cam[inside], sd)
        limits = allowance.limits(float(travelled[inside[-1]] - travelled[inside[0]]))
        compared.append(Window(segment, known[inside], metres, radians, *limits))
    return compared


def worst_by_frame(segment: Segment, compared: list[Window]) -> tuple[Array, Array, np.ndarray]:
    """Each frame's largest residual over its windows, metres and radians (N,), NaN where it is in none; and whether
    it is beyond a limit in any of them (N,)."""
    metres = np.full(len(segment.rows), np.nan)
    radians = np.full(len(segment.rows), np.nan)
    wrong = np.zeros(len(segment.rows), dtype=bool)
    for window in compared:
        metres[window.inside] = np.fmax(metres[window.inside], window.position_m)
        radians[window.inside] = np.fmax(radians[window.inside], window.rotation)
        wrong[window.inside] |= window.wrong
    return metres, radians, wrong
