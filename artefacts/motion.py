"""The cameras' velocities at frames, by the VIO of their sessions."""

import numpy as np
import pandas as pd

from groundwalk.artefacts.tables import poses_of
from groundwalk.geometry.rates import Rates, rates_at

# A rate over a longer time says little of some milliseconds in it.
_MAX_GAP_S = 0.3


def rates_by_vio(frames: pd.DataFrame, log: pd.DataFrame) -> Rates:
    """Rates of N frames from all poses of the log (table import.vio), NaN where none is near enough."""
    rates = Rates(*(np.full((len(frames), 3), np.nan) for _ in range(3)))
    session_N, t_ns = frames["session_id"].to_numpy(str), frames["t_ns"].to_numpy(np.int64)
    for session, poses in log.groupby("session_id"):
        rows, poses = np.flatnonzero(session_N == session), poses.sort_values("t_ns")
        of_session = rates_at(t_ns[rows], poses["t_ns"].to_numpy(np.int64), poses_of(poses, "vio_cam"), _MAX_GAP_S)
        rates.angular[rows], rates.velocity[rows] = of_session.angular, of_session.velocity
        rates.angular_difference[rows] = of_session.angular_difference
    return rates
