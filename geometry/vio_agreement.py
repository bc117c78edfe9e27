"""Does a model move as VIO does? Scale from steps of VIO path, and rigid fits over windows of it.

Over a whole walk VIO's drift would bend the path. Errors of one step have nothing to do with those of the next.

A stretch is what a session walked between two VIO jumps, as the poses of the n frames that both know, in order of time:
`sfm_T_cam` (n, 4, 4) in a model's arbitrary scale and `vio_T_cam` (n, 4, 4) in metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import GeometryError
from groundwalk.geometry.decisions import beyond, within
from groundwalk.geometry.fits import ROBUST_TOLERANCE, fit_poses, fit_robust, pose_residuals
from groundwalk.geometry.poses import Array, relative
from groundwalk.geometry.vio_drift import VioDrift

WINDOW_M = 10.0
"""Short windows suffer from noise of single positions, long ones from bending by VIO's drift."""
STEP_M = 1.0
"""Path of the steps that give the scale, at most: a shorter walk has shorter ones, so that it has several."""
STEP_SCALE_SD = 0.03
"""Expected scale error of a step of a metre, as a share."""

# Frames that a window needs so that a robust fit of 7 unknowns sees which of them is wrong.
LEAST_WINDOW = 6
_FEWEST_FRAMES = 3
# Residuals that nobody minds, where a robust fit stops telling items apart.
_LEAST_SHARE = 0.5  # of the length of SfM's steps that VIO's go along them
_STEP_FLOOR = 1e-2  # of the scale of a step of a metre against its recording's

_STEPS_OF_A_WALK = 8
# Noise of the length of a step, however short: both ends in VIO and in SfM.
_LENGTH_SD_M = 0.003
# A scale that is less certain, as a share, is none: twice that is two thirds of it.
_LARGEST_SCALE_SD = 1 / 3
# Frames that VIO has so far apart and SfM in one place are wrong, not at rest.
_COLLAPSED_M = 0.3
# Over a short window the constant in what VIO may be off by is more than the walk's own extent: it grows with the path
# instead, from a fifth of itself on.
_LEAST_CONSTANT = 0.2


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
    radians), the limits, and the frames' own standard errors in the model (0 where not known)."""

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

    @property
    def undecided(self) -> NDArray[np.bool_]:
        """(n,) frames that may be on either side of a limit."""
        in_position = within(self.position_m, self.position_sd_m, self.limit_m)
        return ~self.wrong & ~(in_position & within(self.rotation, self.rotation_sd, self.limit_rotation))


@dataclass(frozen=True)
class Scale:
    """VIO metres per SfM unit of one recording: natural logarithm, its sigma, and the steps behind it."""

    log: float
    sd: float
    steps: int


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
    frame_sd: tuple[Array, Array] | None = None,
) -> list[WindowResiduals]:
    """The windows of a stretch at metric scale, each with VIO rigidly fitted to it.

    The fit follows the majority of a window's frames, so that single wrong poses stand out. A window needs 3 frames.
    `frame_sd`: the frames' own standard errors in the model, metres and radians (n,).
    """
    if len(vio_T_cam) < _FEWEST_FRAMES:
        return []
    position_sd_m, rotation_sd = np.zeros((2, len(vio_T_cam))) if frame_sd is None else frame_sd
    travelled = path_m(vio_T_cam)
    compared = []
    for inside in path_windows(travelled, window_m):
        _, metres, radians = fit_rigid(metric_T_cam[inside], vio_T_cam[inside], sd, tolerance=tolerance)
        walked_m = travelled[inside[-1]] - travelled[inside[0]]
        limits = _window_limit_m(drift, walked_m), float(drift.radians(walked_m))
        compared.append(WindowResiduals(inside, metres, radians, *limits, position_sd_m[inside], rotation_sd[inside]))
    return compared


def _window_limit_m(drift: VioDrift, walked_m: float) -> float:
    growing_m = drift.m_per_m * walked_m
    return float(growing_m + min(drift.m, max(_LEAST_CONSTANT * drift.m, growing_m)))


def recording_scale(
    stretches: Sequence[Stretch],
    *,
    step_m: float,
    step_sd: float,
    tolerance: float = ROBUST_TOLERANCE,
) -> Scale | None:
    """The scale of a recording's stretches in one model: the robust mean over steps of VIO path, one after the other,
    weighted by what each can tell; None where it would be less certain than to a third.

    Steps are of `step_m`, and of an eighth of a path that is shorter than eight of these. `step_sd`: what the scale of
    a step of a metre is expected to be off by, as a share; a random walk's error grows with the root of the length, and
    noise of the ends doesn't grow. The standard error is that of the scatter that is found, and of what is expected of
    the whole path. Raises GeometryError where SfM puts frames in one place that VIO says are apart.
    """
    stretches = [stretch for stretch in stretches if len(stretch.vio_T_cam) >= _FEWEST_FRAMES]
    whole_m = sum(float(path_m(stretch.vio_T_cam)[-1]) for stretch in stretches)
    sfm, vio = _steps(stretches, min(step_m, whole_m / _STEPS_OF_A_WALK))
    length, squared = np.linalg.norm(vio, axis=1), np.sum(sfm * sfm, axis=1)
    if np.any((squared == 0) & (length >= _COLLAPSED_M)):
        raise GeometryError(f"{np.count_nonzero(squared == 0)} of {len(squared)} steps have no length in SfM")
    moved = (length > 0) & (squared > 0)
    sfm, vio, length, squared = sfm[moved], vio[moved], length[moved], squared[moved]
    if not len(length):
        return None
    by_length = length / np.sqrt(squared)
    usual = float(np.median(by_length))
    # SfM's step is the surer one: VIO's is laid along it, so that VIO's sideways errors don't lengthen it.
    share = np.sum(sfm * vio, axis=1) / squared / usual
    sd = np.hypot(step_sd / np.sqrt(length), _LENGTH_SD_M / length)
    mean, robust = robust_mean(share, sd**-2, sd / step_sd, _STEP_FLOOR, tolerance)
    goes_along = mean >= _LEAST_SHARE
    if not goes_along:
        # The steps go other ways, as where times are shuffled. Their lengths give a scale to show that with.
        share = by_length / usual
        mean, robust = robust_mean(share, sd**-2, sd / step_sd, _STEP_FLOOR, tolerance)
    weight = robust * sd**-2
    effective = max(1.0, float(weight.sum() ** 2 / np.sum(weight**2)))
    scatter = float(np.sum(weight * (share - mean) ** 2) / weight.sum()) / max(1.0, effective - 1)
    # As if one more metre were as wrong as a metre is expected to be: few steps mustn't look certain.
    walked_m = float(np.sum(robust * length))
    expected = step_sd**2 / (walked_m * max(walked_m, 1.0))
    # Noise makes any length longer, all steps alike.
    noise = (_LENGTH_SD_M * len(length) / walked_m) ** 2 / (effective if goes_along else 1.0)
    relative_sd = float(np.sqrt(scatter + expected + noise)) / mean
    if relative_sd > _LARGEST_SCALE_SD:
        return None
    return Scale(float(np.log(mean * usual)), relative_sd, len(length))


def _steps(stretches: Sequence[Stretch], step_m: float) -> tuple[Array, Array]:
    """Steps (M, 3) of `step_m` of VIO path, by SfM and by VIO."""
    found = [np.empty((2, 0, 3))]
    for stretch in stretches:
        a, b = path_steps(path_m(stretch.vio_T_cam), step_m)
        found.append(np.stack([relative(T[a], T[b])[:, :3, 3] for T in stretch]))
    sfm, vio = np.concatenate(found, axis=1)
    return sfm, vio


def path_steps(travelled_m: Array, step_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last frames of steps of `step_m` of a path, or a little more, one after the other; the last one may be
    shorter. `travelled_m` (n,) is how far along it each frame lies."""
    ends = [0]
    while ends[-1] + 1 < len(travelled_m):
        following = int(np.searchsorted(travelled_m, travelled_m[ends[-1]] + step_m))
        ends.append(min(max(following, ends[-1] + 1), len(travelled_m) - 1))
    return np.array(ends[:-1], np.intp), np.array(ends[1:], np.intp)


def robust_mean(
    values: Array, weights: Array, sds: Array, floor: float, tolerance: float = ROBUST_TOLERANCE
) -> tuple[float, Array]:
    """Robust weighted mean of numbers (N,) and their final weights, residuals counted in their `sds`."""
    return fit_robust(
        lambda w: float(np.average(values, weights=w)),
        lambda mean: np.abs(values - mean) / sds,
        len(values),
        floor=floor,
        weights=weights,
        tolerance=tolerance,
    )
