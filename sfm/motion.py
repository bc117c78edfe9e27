"""How each camera moved while its rows were read out, by VIO."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from artefacts.tables import poses_of
from geometry.poses import Array
from geometry.rates import rates_at

# A rate over a longer time says little of some milliseconds in it.
_MOST_GAP_S = 0.3
_UNKNOWN_ANGULAR_SD = 0.3
_LEAST_ANGULAR_SD = 0.005


@dataclass(frozen=True)
class Motion:
    """Of N frames, in the camera's axes: angular velocity (N, 3) in rad/s with one sigma (N,), velocity (N, 3) in m/s,
    0 where VIO has no pose near enough before and after the frame."""

    angular: Array
    angular_sd: Array
    velocity: Array


def motion_by_vio(frames: pd.DataFrame, log: pd.DataFrame) -> Motion:
    """From the frames' poses and all poses of the log (table import.vio).

    Sigma is half of what the rates before and after a frame differ by, root mean square over its session: what a hand
    does between two poses that are logged isn't known any better.
    """
    count = len(frames)
    angular, velocity, sd = np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, _UNKNOWN_ANGULAR_SD)
    session_N, t_ns = frames["session_id"].to_numpy(str), frames["t_ns"].to_numpy(np.int64)
    vio_T_cam = poses_of(frames, "vio_cam")
    by_session = dict(iter(log.groupby("session_id")))
    for session in np.unique(session_N):
        if session not in by_session:
            continue
        rows, poses = np.flatnonzero(session_N == session), by_session[session].sort_values("t_ns")
        rates = rates_at(
            t_ns[rows], vio_T_cam[rows], poses["t_ns"].to_numpy(np.int64), poses_of(poses, "vio_cam"), _MOST_GAP_S
        )
        near = np.isfinite(rates.angular).all(axis=1)
        if not near.any():
            continue
        angular[rows[near]], velocity[rows[near]] = rates.angular[near], rates.velocity[near]
        change = rates.angular_change[np.isfinite(rates.angular_change[:, 0])]
        one_sided = near & ~np.isfinite(rates.angular_change[:, 0])
        scatter = float(np.sqrt(np.mean(change**2))) / 2 if len(change) else _UNKNOWN_ANGULAR_SD
        sd[rows[near]] = max(scatter, _LEAST_ANGULAR_SD)
        sd[rows[one_sided]] *= 2
    return Motion(angular, sd, velocity)
