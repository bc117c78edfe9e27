"""How each camera moved while its rows were read out, by VIO, and the offset between a frame's time stamp and its
middle row, from turns in a model and in VIO.

Where the middle row was exposed dt before the time stamp, VIO's poses are those of dt later: from frame to frame its
rotation differs from that of the images by exp(w_a dt) in front and exp(-w_b dt) behind, with the angular velocities w.
A constant rotation of the camera against VIO's, or slow drift, doesn't look like that.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, relative
from groundwalk.geometry.rates import Rates, rates_at
from groundwalk.geometry.robust import CAUCHY_WIDTH, cauchy_weights
from groundwalk.sfm.database import image_id, pose_of
from groundwalk.store.tables import poses_of

UNKNOWN_ANGULAR_SD = 0.3
_MIN_ANGULAR_SD = 0.005
# A rate over a longer time says little of some milliseconds in it.
MAX_GAP_S = 0.3
_STEPS = 10
_MIN_PAIRS, _BLOCKS = 10, 15
_MIN_SD_RAD = 1e-4
_MIN_SIGMAS = 3.0
# Apps stamp the start or the end of an exposure or readout, or when they were handed the image.
_PRIOR_SD_S = 0.03


@dataclass(frozen=True)
class Motion:
    """Of N frames, in the camera's axes: angular velocity (N, 3) in rad/s with its sd (N,), velocity (N, 3) in m/s,
    0 where VIO has no pose near enough before and after the frame: where it isn't `known` (N,)."""

    angular: Array
    angular_sd: Array
    velocity: Array
    known: NDArray[np.bool_]


def motion_by_vio(
    frames: pd.DataFrame, log: pd.DataFrame, jumps: pd.DataFrame, time_offset_s: Array | float = 0.0
) -> Motion:
    """From all poses of the log and its jumps (tables import.vio and import.jumps), `time_offset_s` (N,) before the
    frames' time stamps.

    The sd is half of what the rates of splines and of neighbouring poses differ by, root mean square over the session:
    the motion of a hand between two logged poses isn't known better.
    """
    rates = Rates(*(np.full((len(frames), 3), np.nan) for _ in range(3)))
    session_N, t_ns = frames["session_id"].to_numpy(str), frames["t_ns"].to_numpy(np.int64)
    t_ns = t_ns - np.round(1e9 * np.asarray(time_offset_s)).astype(np.int64)
    for session, poses in log.groupby("session_id"):
        rows, poses = np.flatnonzero(session_N == session), poses.sort_values("t_ns")
        log_t_ns, jump_t_ns = (t["t_ns"].to_numpy(np.int64) for t in (poses, jumps[jumps["session_id"] == session]))
        of_session = rates_at(t_ns[rows], log_t_ns, poses_of(poses, "vio_cam"), MAX_GAP_S, jump_t_ns)
        rates.angular[rows], rates.velocity[rows] = of_session.angular, of_session.velocity
        rates.angular_difference[rows] = of_session.angular_difference
    has_rate = ~np.isnan(rates.angular[:, 0])
    has_difference = ~np.isnan(rates.angular_difference[:, 0])
    sd = np.full(len(frames), UNKNOWN_ANGULAR_SD)
    for session in np.unique(session_N[has_difference]):
        members = (session_N == session) & has_rate
        scatter = float(np.sqrt(np.mean(rates.angular_difference[members & has_difference] ** 2)))
        sd[members] = max(scatter / 2, _MIN_ANGULAR_SD)
        sd[members & ~has_difference] *= 2
    angular, velocity = (np.where(has_rate[:, None], rate, 0.0) for rate in (rates.angular, rates.velocity))
    return Motion(angular, sd, velocity, has_rate)


def offset_of_frames(
    model: pycolmap.Reconstruction, session_N: np.ndarray, t_s: Array, vio_T_cam: Array, angular: Array
) -> float:
    """Time stamps minus times of the middle rows, s, of all frames of a model: `session_N` (N,) names, `t_s` (N,),
    `vio_T_cam` (N, 4, 4) and angular velocities (N, 3) at the time stamps are of all N frames. 0 for too few pairs of
    neighbours, or where it isn't three standard errors.

    Shrunk to a prior of 0 ± 30 ms, for phones that hardly turn. VIO's drift correlates pairs of about the same time,
    and a few turns have most of the leverage: the standard error is a block jackknife's, which leaves out successive
    pairs together (Kuensch, Annals of Statistics 17, 1989).
    """
    rows = np.array(sorted(i - 1 for i in model.reg_image_ids()), np.int64)
    rows = rows[np.isfinite(vio_T_cam[rows, 0, 0]) & np.abs(angular[rows]).any(axis=1)]
    rows = rows[np.lexsort([t_s[rows], session_N[rows].astype(str)])]
    is_pair = session_N[rows[:-1]] == session_N[rows[1:]]
    a, b = rows[:-1][is_pair], rows[1:][is_pair]
    if len(a) < _MIN_PAIRS:
        return 0.0
    sfm_T_cam = np.stack([pose_of(model.image(image_id(row))) for row in rows.tolist()])
    by_images = relative(sfm_T_cam[:-1], sfm_T_cam[1:])[is_pair, :3, :3]
    all_pairs = by_images, relative(vio_T_cam[a], vio_T_cam[b])[:, :3, :3], angular[a], angular[b]
    offset, prior_variance = _offset_of(*all_pairs)
    left_out = np.array_split(np.arange(len(a)), min(_BLOCKS, len(a)))
    without = np.array([_offset_of(*(np.delete(part, block, axis=0) for part in all_pairs))[0] for block in left_out])
    sd = float(np.sqrt((len(without) - 1) * without.var() + prior_variance))
    return offset if abs(offset) > _MIN_SIGMAS * sd else 0.0


def _offset_of(by_images: Array, by_vio: Array, angular_a: Array, angular_b: Array) -> tuple[float, float]:
    """The offset, s, that fits rotations of pairs a_R_b (P, 3, 3) by images and by VIO best, with both frames' angular
    velocities (P, 3), and the prior's part of its variance, s^2."""
    slope = np.einsum("pji,pj->pi", by_images, angular_a) - angular_b
    offset, information, prior, sd_rad = 0.0, 0.0, 0.0, 0.0
    for _ in range(_STEPS):
        before_a, before_b = (Rotation.from_rotvec(-offset * w).as_matrix() for w in (angular_a, angular_b))
        at_offset = np.swapaxes(before_a, 1, 2) @ by_vio @ before_b
        difference = Rotation.from_matrix(np.swapaxes(by_images, 1, 2) @ at_offset).as_rotvec()
        # The median length of three normal components is 1.54 sigma.
        sd_rad = max(float(np.median(np.linalg.norm(difference, axis=1))) / 1.54, _MIN_SD_RAD)
        weight = cauchy_weights(difference, CAUCHY_WIDTH * sd_rad)
        prior = (sd_rad / _PRIOR_SD_S) ** 2
        information = float(np.sum(weight * np.sum(slope**2, axis=1))) + prior
        pull = float(np.sum(weight * np.sum(slope * difference, axis=1)))
        offset -= (pull + prior * offset) / information
    return offset, prior * sd_rad**2 / information**2
