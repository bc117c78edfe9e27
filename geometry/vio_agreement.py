"""Does a model move as VIO does? Scale and rigid fits over windows of VIO path, which drift over a walk can't bend.

A stretch is what a session walked between two VIO jumps, as the poses of the n frames that both know, in order of time:
`sfm_T_cam` (n, 4, 4) in a model's arbitrary scale and `vio_T_cam` (n, 4, 4) in metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.fits import ROBUST_TOLERANCE, Sim3, fit_poses, fit_robust, fit_sim3, pose_residuals
from geometry.poses import Array
from geometry.vio_drift import VioDrift

WINDOW_M = 10.0
"""Short windows suffer from noise of single positions, long ones from bending by VIO's drift."""
LEAST_EXTENT_M = 0.15
"""Windows whose VIO positions spread less (root mean square) say nothing about scale."""
WINDOW_SCALE_SD = 0.01
"""Expected scale error of one window, as a share."""

# Frames that a window needs so that a robust fit of 7 unknowns sees which of them is wrong.
LEAST_WINDOW = 6
_FEWEST_FRAMES = 3
# Residuals that nobody minds, where a robust fit stops telling items apart.
_WINDOW_FLOOR = 2e-3  # of the window's extent: 2 mm a metre
_SCALE_FLOOR = 1e-3  # of a window's scale against its recording's


class Stretch(NamedTuple):
    """See above."""

    sfm_T_cam: Array
    vio_T_cam: Array


@dataclass(frozen=True)
class PoseSd:
    """How position counts against rotation in fits of VIO to the map: metres and radians."""

    position_m: float
    rotation: float


POSE_SD = PoseSd(0.01, float(np.radians(1.0)))


@dataclass(frozen=True)
class WindowResiduals:
    """What is left in a window after VIO was fitted to it: indices (n,) of its frames, their residuals (metres,
    radians) and the limits."""

    inside: NDArray[np.intp]
    position_m: Array
    rotation: Array
    limit_m: float
    limit_rotation: float

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(n,) frames beyond a limit."""
        return (self.position_m > self.limit_m) | (self.rotation > self.limit_rotation)


@dataclass(frozen=True)
class Scale:
    """VIO metres per SfM unit of one recording: natural logarithm, its sigma, and the windows behind it."""

    log: float
    sd: float
    windows: int


def path_m(vio_T_cam: Array) -> Array:
    """Length of the path (n,) from the first of the poses (n, 4, 4) on."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vio_T_cam[:, :3, 3], axis=0), axis=1))])


def path_windows(travelled_m: Array, length_m: float, least_frames: int = LEAST_WINDOW) -> list[NDArray[np.intp]]:
    """Indices (k,) of the frames in windows of `length_m` of a path, each half over the next; `travelled_m` (n,) is how
    far along it each frame lies.

    The windows are spread so that the last one ends with the path; a shorter path is one window. Where frames are far
    apart a window is longer, so that it has `least_frames`; a path of fewer is one window.
    """
    count = len(travelled_m)
    whole_m = float(travelled_m[-1])
    steps = 0 if whole_m <= length_m else int(np.ceil((whole_m - length_m) / (length_m / 2)))
    starts = np.linspace(0.0, max(whole_m - length_m, 0.0), steps + 1)
    # Rounding must not cost a window its last frame.
    slack = 1e-9 * (1 + whole_m)
    first = np.searchsorted(travelled_m, starts - slack)
    last = np.searchsorted(travelled_m, starts + length_m + slack, side="right")
    last = np.minimum(np.maximum(last, first + least_frames), count)
    first = np.maximum(np.minimum(first, last - least_frames), 0)
    return [np.arange(a, b) for a, b in dict.fromkeys(zip(first.tolist(), last.tolist(), strict=True))]


def fit_rigid(
    map_T_cam: Array,
    vio_T_cam: Array,
    sd: PoseSd,
    *,
    yaw_only: bool = False,
    tolerance: float = ROBUST_TOLERANCE,
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
    metric_T_cam: Array,
    vio_T_cam: Array,
    window_m: float,
    drift: VioDrift,
    sd: PoseSd,
    tolerance: float = ROBUST_TOLERANCE,
) -> list[WindowResiduals]:
    """The windows of a stretch at metric scale, each with VIO rigidly fitted to it.

    The fit follows the majority of a window's frames, so that single wrong poses stand out. A window needs 3 frames.
    """
    if len(vio_T_cam) < _FEWEST_FRAMES:
        return []
    travelled = path_m(vio_T_cam)
    compared = []
    for inside in path_windows(travelled, window_m):
        _, metres, radians = fit_rigid(metric_T_cam[inside], vio_T_cam[inside], sd, tolerance=tolerance)
        walked_m = travelled[inside[-1]] - travelled[inside[0]]
        limits = float(drift.metres(walked_m)), float(drift.radians(walked_m))
        compared.append(WindowResiduals(inside, metres, radians, *limits))
    return compared


def recording_scale(
    stretches: Sequence[Stretch],
    *,
    window_m: float,
    least_extent_m: float,
    window_sd: float,
    tolerance: float = ROBUST_TOLERANCE,
) -> Scale | None:
    """The scale of a recording's stretches in one model: the robust mean of its windows' own, weighted by the mean
    square extent of their paths; None where none of them moves enough.

    `least_extent_m`: windows whose VIO positions spread less (root mean square) say nothing about scale. `window_sd`:
    what a window's scale is expected to be off by, as a share; the scatter that is found adds to it. Raises
    GeometryError where SfM puts frames in one place that VIO says are apart.
    """
    logs, spreads = [], []
    for stretch in stretches:
        if len(stretch.vio_T_cam) < _FEWEST_FRAMES:
            continue
        for inside in path_windows(path_m(stretch.vio_T_cam), window_m):
            sfm, vio = stretch.sfm_T_cam[inside, :3, 3], stretch.vio_T_cam[inside, :3, 3]
            if extent(vio) < least_extent_m:
                continue
            scale, weights = _window_scale(sfm, vio, tolerance)
            logs.append(-np.log(scale))
            spreads.append(extent(vio, weights) ** 2)
    if not logs:
        return None
    log, spread = np.array(logs), np.array(spreads)
    mean, robust = robust_mean(log, spread, np.ones(len(log)), _SCALE_FLOOR)
    weight = robust * spread
    # Each window shares half its path with the next one: together they count for half as many.
    effective = max(1.0, float(weight.sum() ** 2 / np.sum(weight**2)) / (2 if len(log) > 1 else 1))
    scatter = float(np.sum(weight * (log - mean) ** 2) / weight.sum())
    variance = (effective * scatter + window_sd**2) / effective
    return Scale(mean, float(np.sqrt(variance / effective)), len(log))


def robust_mean(values: Array, weights: Array, sds: Array, floor: float) -> tuple[float, Array]:
    """Robust weighted mean of numbers (N,) and their final weights, residuals counted in their `sds`."""
    return fit_robust(
        lambda w: float(np.average(values, weights=w)),
        lambda mean: np.abs(values - mean) / sds,
        len(values),
        floor=floor,
        weights=weights,
    )


def extent(xyz: Array, weights: Array | None = None) -> float:
    """Root mean square distance of points (N, 3) from their mean."""
    mean = np.average(xyz, axis=0, weights=weights)
    return float(np.sqrt(np.average(np.sum((xyz - mean) ** 2, axis=1), weights=weights)))


def _window_scale(sfm: Array, vio: Array, tolerance: float) -> tuple[float, Array]:
    """SfM units per VIO metre of one window, and the frames' weights: wrong SfM poses have none.

    SfM is fitted to, as its wrong poses are gross; as the side that is fitted from they'd be leverage points. A turn
    about a straight path isn't determined and doesn't matter here.
    """
    size = extent(vio)

    def residuals(sfm_S_vio: Sim3) -> Array:
        return np.linalg.norm(sfm - sfm_S_vio.points(vio), axis=1) / (sfm_S_vio.scale * size)

    sfm_S_vio, weights = fit_robust(
        lambda w: fit_sim3(sfm, vio, w, line_ok=True),
        residuals,
        len(sfm),
        floor=_WINDOW_FLOOR,
        tolerance=tolerance,
    )
    return sfm_S_vio.scale, weights
