"""Metres of VIO for a unit of a model, from steps of VIO path: the errors of steps are independent."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundwalk.consistency.trajectories import TrajectoryPair, path_steps
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import ROBUST_TOLERANCE, fit_robust
from groundwalk.geometry.poses import Array, path_length, relative

# Path of the steps that give the scale, at most: a shorter walk has shorter ones, so that it has several.
_STEP_M = 1.0
STEP_SCALE_SD = 0.03
"""Expected scale error of a step of a metre, as a fraction."""

_MIN_FRAMES = 3
# VIO's steps go along SfM's where their components along these are at least this fraction of their length.
_MIN_STEP_RATIO = 0.5
# Smaller residuals, of a step of a metre, count alike in the robust fit.
_STEP_FLOOR = 1e-2
_MIN_STEPS = 8
# Noise of the length of a step, however short: both ends in VIO and in SfM.
_LENGTH_SD_M = 0.003
# A scale with a larger standard error, as a fraction, is None: twice that is two thirds of it.
UNKNOWN_SCALE_SD = 1 / 3
# Frames that VIO has so far apart and SfM in one place are wrong, not at rest.
_COLLAPSED_M = 0.3


@dataclass(frozen=True)
class Scale:
    """VIO metres per SfM unit of one recording: natural logarithm, its standard error, and the number of steps."""

    log: float
    sd: float
    steps: int


def recording_scale(parts: Sequence[TrajectoryPair], tolerance: float = ROBUST_TOLERANCE) -> Scale | None:
    """The scale of a recording's parts in one model: the robust mean over steps of VIO path, one after the other,
    weighted by their certainty; None where its standard error is above a third.

    Steps are of a metre, and of an eighth of a path that is shorter than eight of these. The expected error of a step's
    scale is that of a random walk, which grows with the root of the length, and noise of the ends, which doesn't. The
    standard error is that of the observed scatter, and of what is expected of the whole path. Raises GeometryError
    where SfM puts frames in one place that VIO says are apart.
    """
    parts = [part for part in parts if len(part.vio_T_cam) >= _MIN_FRAMES]
    total_m = sum(float(path_length(part.vio_T_cam[:, :3, 3])[-1]) for part in parts)
    # Steps (M, 3) of VIO's path, by SfM and by VIO.
    steps = [np.empty((2, 0, 3))]
    for part in parts:
        a, b = path_steps(path_length(part.vio_T_cam[:, :3, 3]), min(_STEP_M, total_m / _MIN_STEPS))
        steps.append(np.stack([relative(T[a], T[b])[:, :3, 3] for T in (part.sfm_T_cam, part.vio_T_cam)]))
    sfm, vio = np.concatenate(steps, axis=1)
    length, squared = np.linalg.norm(vio, axis=1), np.sum(sfm * sfm, axis=1)
    if np.any((squared == 0) & (length >= _COLLAPSED_M)):
        raise GeometryError(f"{np.count_nonzero(squared == 0)} of {len(squared)} steps have no length in SfM")
    moved = (length > 0) & (squared > 0)
    sfm, vio, length, squared = sfm[moved], vio[moved], length[moved], squared[moved]
    if not len(length):
        return None
    by_length = length / np.sqrt(squared)
    median = float(np.median(by_length))
    # SfM's step is the more certain one: VIO's is laid along it, so that VIO's sideways errors don't lengthen it.
    ratio = np.sum(sfm * vio, axis=1) / squared / median
    sd = np.hypot(STEP_SCALE_SD / np.sqrt(length), _LENGTH_SD_M / length)
    mean, robust = robust_mean(ratio, sd**-2, sd / STEP_SCALE_SD, _STEP_FLOOR, tolerance)
    goes_along = mean >= _MIN_STEP_RATIO
    if not goes_along:
        # The steps go other ways, as where times are shuffled. Their lengths give a scale to show that with.
        ratio = by_length / median
        mean, robust = robust_mean(ratio, sd**-2, sd / STEP_SCALE_SD, _STEP_FLOOR, tolerance)
    weight = robust * sd**-2
    effective = max(1.0, float(weight.sum() ** 2 / np.sum(weight**2)))
    scatter = float(np.sum(weight * (ratio - mean) ** 2) / weight.sum()) / max(1.0, effective - 1)
    # As if one more metre were as wrong as a metre is expected to be: few steps mustn't look certain.
    walked_m = float(np.sum(robust * length))
    expected = STEP_SCALE_SD**2 / (walked_m * max(walked_m, 1.0))
    # Noise makes any length longer, all steps alike.
    noise = (_LENGTH_SD_M * len(length) / walked_m) ** 2 / (effective if goes_along else 1.0)
    relative_sd = float(np.sqrt(scatter + expected + noise)) / mean
    if relative_sd > UNKNOWN_SCALE_SD:
        return None
    return Scale(float(np.log(mean * median)), relative_sd, len(length))


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
