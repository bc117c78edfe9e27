"""How each camera moved while its rows were read out, by VIO."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.artefacts.tables import poses_of
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rates import rates_at

# A rate over a longer time says little of some milliseconds in it.
_MAX_GAP_S = 0.3
_UNKNOWN_ANGULAR_SD = 0.3
_MIN_ANGULAR_SD = 0.005


@dataclass(frozen=True)
class Motion:
    """Of N frames, in the camera's axes: angular velocity (N, 3) in rad/s with one sigma (N,), velocity (N, 3) in m/s,
    0 where VIO has no pose near enough before and after the frame."""

    angular: Array
    angular_sd: Array
    velocity: Array


def motion_by_vio(frames: pd.DataFrame, log: pd.DataFrame) -> Motion:
    """From the frames' poses and all poses of the log (table import.vio).

    Sigma is half of what the rates of splines and of neighbouring poses differ by, root mean square over its session:
    what a hand does between two poses that are logged isn't known any better.
    """
    count = len(frames)
    angular, velocity, sd = np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, _UNKNOWN_ANGULAR_SD)
    session_N, t_ns = frames["session_id"].to_numpy(str), frames["t_ns"].to_numpy(np.int64)
    by_session = dict(iter(log.groupby("session_id")))
    for session in np.unique(session_N):
        if session not in by_session:
            continue
        rows, poses = np.flatnonzero(session_N == session), by_session[session].sort_values("t_ns")
        rates = rates_at(t_ns[rows], poses["t_ns"].to_numpy(np.int64), poses_of(poses, "vio_cam"), _MAX_GAP_S)
        near = np.isfinite(rates.angular).all(axis=1)
        if not near.any():
            continue
        angular[rows[near]], velocity[rows[near]] = rates.angular[near], rates.velocity[near]
        compared = np.isfinite(rates.angular_difference[:, 0])
        if compared.any():
            scatter = float(np.sqrt(np.mean(rates.angular_difference[compared] ** 2)))
            sd[rows[near]] = max(scatter / 2, _MIN_ANGULAR_SD)
            sd[rows[near & ~compared]] *= 2
    return Motion(angular, sd, velocity)
