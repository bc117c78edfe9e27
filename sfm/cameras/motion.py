"""How each camera moved while its rows were read out, by VIO."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rates import Rates, rates_at
from groundwalk.store.tables import poses_of

UNKNOWN_ANGULAR_SD = 0.3
_MIN_ANGULAR_SD = 0.005
# A rate over a longer time says little of some milliseconds in it.
MAX_GAP_S = 0.3


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
