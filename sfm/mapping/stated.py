"""Whether the images of a model deny what a capture states of its lenses: distortion and readout time.

The model is adjusted twice, with what is stated and almost without a prior. Only matches that took no part in either
judge: a lens that follows noise, or takes up what a wrong geometry leaves, doesn't explain these better.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pycolmap
from scipy.special import ndtr, stdtrit

from groundwalk.geometry.lens import distort_with_slope, max_shift, undistort
from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import LENS_UNKNOWNS, RADIAL, READOUT, Adjusted
from groundwalk.sfm.cameras.lenses import FAR_SD, K3_SD, READOUT_SD_S, LensPrior
from groundwalk.sfm.cameras.model_adjustment import CameraLog, Held
from groundwalk.sfm.mapping.held_out import Matches
from groundwalk.sfm.mapping.misplaced import adjust_without_misplaced, check_of
from groundwalk.sfm.quality.covariance import covariances
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin

_WEAK_COVARIANCE = np.diag([*FAR_SD, READOUT_SD_S]) ** 2
# A stated distortion is wrong where the estimate is so many sigmas and pixels away from it, doesn't stretch or shrink
# the image at its corners by more than this fraction, and errors of held-out matches become smaller by another one and
# so many standard errors; a stated readout time where it is so many sigmas and seconds away.
_MIN_WRONG_SIGMAS, _MIN_WRONG_PX, _MAX_CORNER_GROWTH = 5.0, 1.0, 0.6
_MIN_WRONG_GAIN, _MIN_GAIN_SIGMAS, _MIN_ERROR_PX = 0.04, 3.0, 0.01
_MIN_WRONG_READOUT_S = 0.004


@dataclass(frozen=True)
class StatedCheck:
    """What the images of a model say of lens number `lens` of the scene: whether its stated distortion is wrong, or
    looks so but not beyond chance, whether its stated readout time is wrong, and the median error of held-out matches
    with what is stated and with what the images say, px."""

    lens: int
    distortion_is_wrong: bool
    distortion_is_undecided: bool
    readout_is_wrong: bool
    held_out_stated_px: float
    held_out_free_px: float


def check_stated(
    model: pycolmap.Reconstruction,
    matches: Matches,
    keypoints: list[Array],
    log: CameraLog,
    settings: SfmSettings,
    held: Held,
) -> tuple[CameraLog, list[StatedCheck]]:
    """What the images of a model, which stays as it is, say of the stated lenses of its frames; and the log in which
    those that are wrong are to be estimated, unless settings hold them. Raises LinAlgError where its images don't
    determine the model."""
    rows = np.array(sorted(set(model.reg_frame_ids()) - held.frames), np.int64) - 1
    lenses = {k: log.lenses.priors[k] for k in np.unique(log.lenses.lens[rows]).tolist()}
    stated = [k for k, of in lenses.items() if of.origin == CameraOrigin.STATED or of.stated_readout_s is not None]
    if not stated or settings.refine_cameras == "never":
        return log, []
    weak = log.with_priors(
        {
            k: _weakened(
                prior := log.lenses.priors[k],
                distortion=prior.origin == CameraOrigin.STATED,
                readout=prior.stated_readout_s is not None,
            )
            for k in stated
        }
    )
    errors = []
    for tried in (log, weak):
        copy = pycolmap.Reconstruction(model)
        adjusted, rows, _ = adjust_without_misplaced(copy, matches, keypoints, tried, settings, held)
        of_matches = check_of(copy, matches, tried, adjusted, rows)
        errors.append(of_matches[of_matches["held_out"]].set_index(["a", "b"])["error_px"])
    estimate = covariances(adjusted)
    numbers = np.unique(log.lenses.lens[rows]).tolist()
    checks, decided = [], {}
    for lens in (k for k in stated if k in numbers):
        prior, number = log.lenses.priors[lens], numbers.index(lens)
        of_lens = [one[log.lenses.lens[one.index.get_level_values("a")] == lens] for one in errors]
        medians = [float(one.median()) for one in of_lens]
        first = int(np.flatnonzero(log.lenses.lens == lens)[0])
        denied, readout_denied = False, False
        if estimate is not None:
            denied = _is_denied(prior, adjusted, estimate.shared, number, log.intrinsics[first])
            readout_denied = _readout_is_denied(prior, adjusted, estimate.shared, number)
        wrong = denied and _is_better(*of_lens)
        check = StatedCheck(lens, wrong, denied and not wrong, readout_denied, *medians)
        checks.append(check)
        is_free = wrong and settings.lens != "stated"
        origin = CameraOrigin.ESTIMATED if is_free else prior.origin
        decided[lens] = replace(
            _weakened(prior, distortion=is_free, readout=readout_denied),
            origin=origin,
            is_undecided=check.distortion_is_undecided,
        )
    return log.with_priors(decided), checks


def _weakened(prior: LensPrior, *, distortion: bool, readout: bool) -> LensPrior:
    """A lens of whose distortion, or readout time, hardly anything is known."""
    covariance, k3_sd = prior.covariance.copy(), prior.k3_sd
    if distortion:
        covariance[:2, :2], k3_sd = _WEAK_COVARIANCE[:2, :2], K3_SD
    if readout:
        covariance[2, 2] = _WEAK_COVARIANCE[2, 2]
    return replace(prior, covariance=covariance, k3_sd=k3_sd)


def _is_better(before: pd.Series, after: pd.Series) -> bool:
    """The median errors of pairs become smaller by more than scatters from pair to pair (Student's t: few pairs hardly
    tell their scatter)."""
    medians = [one.groupby(level=["a", "b"]).median().clip(lower=_MIN_ERROR_PX) for one in (before, after)]
    gain = np.log((medians[0] / medians[1]).dropna())
    if len(gain) < 2:
        return False
    limit = stdtrit(len(gain) - 1, ndtr(_MIN_GAIN_SIGMAS)) * gain.std() / np.sqrt(len(gain))
    return bool(gain.mean() > max(limit, _MIN_WRONG_GAIN))


def _is_denied(prior: LensPrior, free: Adjusted, shared: Array, number: int, intrinsics: Array) -> bool:
    """A model adjusted almost without a prior shows another distortion than the stated one, and one that a lens can
    have; `shared` is the covariance of what frames share, `intrinsics` (4,) are of one of the lens's frames."""
    if prior.origin != CameraOrigin.STATED:
        return False
    coefficients = free.cameras.coefficients[number]
    extent = intrinsics[2:] / intrinsics[:2]
    shift_px = max_shift(coefficients, prior.coefficients, (extent[0], extent[1])) * intrinsics[0]
    of_lens = slice(LENS_UNKNOWNS * number, LENS_UNKNOWNS * number + len(RADIAL))
    error = (coefficients - prior.coefficients)[RADIAL]
    sigmas = np.sqrt(error @ np.linalg.solve(shared[of_lens, of_lens], error))
    corner = np.array([[float(np.hypot(*extent)), 0.0]])
    growth = distort_with_slope(undistort(corner, coefficients), coefficients)[1][0, 0, 0]
    # Not so where the polynomial has no such point: NaN.
    is_possible = abs(growth - 1) < _MAX_CORNER_GROWTH
    return bool(sigmas > _MIN_WRONG_SIGMAS and shift_px > _MIN_WRONG_PX and is_possible)


def _readout_is_denied(prior: LensPrior, free: Adjusted, shared: Array, number: int) -> bool:
    if prior.stated_readout_s is None:
        return False
    readout = LENS_UNKNOWNS * number + READOUT
    sd_s = np.sqrt(shared[readout, readout])
    limit_s = max(_MIN_WRONG_SIGMAS * sd_s, _MIN_WRONG_READOUT_S)
    return bool(abs(free.cameras.readout_s[number] - prior.stated_readout_s) > limit_s)
