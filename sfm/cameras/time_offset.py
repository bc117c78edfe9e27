"""The offset between a frame's time stamp and its middle row, from turns in pairs of images and in VIO.

Where the middle row was exposed dt before the time stamp, VIO's poses are those of dt later: in a pair of frames its
relative rotation differs from that of the images by exp(w_a dt) in front and exp(-w_b dt) behind, with the angular
velocities w. A constant rotation of the camera against VIO's, or slow drift, doesn't look like that.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array
from groundwalk.geometry.robust import CAUCHY_WIDTH, cauchy_weights
from groundwalk.sfm.cameras.lens_from_pairs import LensEstimate, PairMatches, sampson_of

_STEPS = 10
_MIN_PAIRS, _BLOCKS = 10, 15
_MIN_SD_RAD = 1e-4
# Apps stamp the start or the end of an exposure or readout, or when they were handed the image.
_PRIOR_SD_S = 0.03


class TimeOffset(NamedTuple):
    """Time stamp minus time of the middle row, s, its standard error, and whether held-out pairs agree better with
    VIO's rotations at this offset from the time stamps than at these."""

    offset_s: float
    sd_s: float
    accepted: bool


def estimate_time_offset(
    fitted: LensEstimate, matches: PairMatches, held_out_P: NDArray[np.bool_], vio_a_R_b: Array
) -> TimeOffset | None:
    """The offset that all pairs share, from the poses fitted to `matches`; those held out only say whether it fits.

    `vio_a_R_b` (P, 3, 3) are the pairs' rotations by VIO at the time stamps, NaN where there are none. None for too few
    pairs. The offset is shrunk to a prior of 0 ± 30 ms, for phones that hardly turn. A Cauchy loss on the difference of
    rotations. VIO's drift correlates pairs of about the same time, and a few turns have most of the leverage: the
    standard error is a block jackknife's, which leaves out successive pairs together (Kuensch, Annals of Statistics 17,
    1989).
    """
    has_vio = np.isfinite(vio_a_R_b[:, 0, 0])
    used, checked = has_vio & ~held_out_P, has_vio & held_out_P
    if used.sum() < _MIN_PAIRS or not checked.any():
        return None
    angular = matches.twist[:, :, :3]
    turns = fitted.a_T_b[used, :3, :3], vio_a_R_b[used], angular[used, 0], angular[used, 1]
    offset, prior_variance = _offset_of(*turns)
    in_time = np.argsort(matches.frames[used].sum(axis=1), kind="stable")
    left_out = np.array_split(in_time, min(_BLOCKS, len(in_time)))
    without = np.array([_offset_of(*(np.delete(part, block, axis=0) for part in turns))[0] for block in left_out])
    variance = (len(without) - 1) * without.var()
    errors = []
    for at in (0.0, offset):
        a_T_b = fitted.a_T_b[checked]
        a_T_b[:, :3, :3] = rotations_at(vio_a_R_b[checked], angular[checked, 0], angular[checked, 1], at)
        errors.append(float(np.median(np.abs(sampson_of(matches.of_pairs(checked), a_T_b, fitted.parameters)))))
    return TimeOffset(offset, float(np.sqrt(variance + prior_variance)), errors[1] < errors[0])


def _offset_of(by_images: Array, by_vio: Array, angular_a: Array, angular_b: Array) -> tuple[float, float]:
    """The offset, s, that fits rotations of pairs a_R_b (P, 3, 3) by images and by VIO best, with both frames' angular
    velocities (P, 3), and the prior's part of its variance, s^2."""
    slope = np.einsum("pji,pj->pi", by_images, angular_a) - angular_b
    offset, information, prior, sd_rad = 0.0, 0.0, 0.0, 0.0
    for _ in range(_STEPS):
        at_offset = rotations_at(by_vio, angular_a, angular_b, offset)
        difference = Rotation.from_matrix(np.swapaxes(by_images, 1, 2) @ at_offset).as_rotvec()
        # The median length of three normal components is 1.54 sigma.
        sd_rad = max(float(np.median(np.linalg.norm(difference, axis=1))) / 1.54, _MIN_SD_RAD)
        weight = cauchy_weights(difference, CAUCHY_WIDTH * sd_rad)
        prior = (sd_rad / _PRIOR_SD_S) ** 2
        information = float(np.sum(weight * np.sum(slope**2, axis=1))) + prior
        pull = float(np.sum(weight * np.sum(slope * difference, axis=1)))
        offset -= (pull + prior * offset) / information
    return offset, prior * sd_rad**2 / information**2


def rotations_at(a_R_b: Array, angular_a: Array, angular_b: Array, offset_s: float) -> Array:
    """Rotations of pairs (P, 3, 3) a time before their time stamps, by the frames' angular velocities (P, 3)."""
    before_a, before_b = (Rotation.from_rotvec(-offset_s * w).as_matrix() for w in (angular_a, angular_b))
    return np.swapaxes(before_a, 1, 2) @ a_R_b @ before_b
