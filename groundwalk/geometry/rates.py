"""Angular velocity and velocity of a camera from poses around a moment."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from groundwalk.geometry.poses import Array

_SAME_TIME_NS = 1_000_000
NO_JUMPS = np.empty(0, np.int64)


@dataclass(frozen=True)
class Rates:
    """Of N moments: angular velocity (N, 3), rad/s, and velocity (N, 3), m/s, in the axes of the camera at that moment,
    NaN where no poses are near enough; and `angular_difference` (N, 3), rad/s: the spline's angular velocity minus that
    of the poses next to the moment alone, NaN where there is none on one side."""

    angular: Array
    velocity: Array
    angular_difference: Array


def rates_at(
    t_ns_N: NDArray[np.int64],
    log_t_ns_K: NDArray[np.int64],
    log_world_T_cam_K: Array,
    gap_s: float,
    jump_t_ns: NDArray[np.int64] = NO_JUMPS,
) -> Rates:
    """Rates at times (N,) from a log's poses (K, 4, 4) at rising times (K,), NaN where the log has none.

    Derivatives of cubic splines through the poses (rotations: Kang and Park, "Cubic spline algorithms for orientation
    interpolation", 1999). At 10 poses a second, differences of neighbours take a quarter off motion at 2 Hz, as that of
    steps, and splines a fiftieth. There is no rate between poses that are more than `gap_s` apart, or that the log
    jumps between (`jump_t_ns` are the times of the first poses after jumps).
    """
    rates = Rates(*(np.full((len(t_ns_N), 3), np.nan) for _ in range(3)))
    has_pose = np.isfinite(log_world_T_cam_K[:, 0, 0])
    log_t_ns, poses = log_t_ns_K[has_pose], log_world_T_cam_K[has_pose]
    gaps = np.flatnonzero(np.diff(log_t_ns) > gap_s * 1e9) + 1
    for run in np.split(np.arange(len(log_t_ns)), np.union1d(gaps, np.searchsorted(log_t_ns, jump_t_ns))):
        if len(run) < 2:
            continue
        start = log_t_ns[run[0]]
        inside = np.flatnonzero((t_ns_N >= start - _SAME_TIME_NS) & (t_ns_N <= log_t_ns[run[-1]] + _SAME_TIME_NS))
        t_s, log_s = (t_ns_N[inside] - start) * 1e-9, (log_t_ns[run] - start) * 1e-9
        turning = RotationSpline(log_s, Rotation.from_matrix(poses[run, :3, :3]))
        rates.angular[inside] = turning(t_s, 1)
        speed = CubicSpline(log_s, poses[run, :3, 3])(t_s, 1)
        rates.velocity[inside] = turning(t_s).inv().apply(speed)
        rates.angular_difference[inside] = rates.angular[inside] - _of_neighbours(turning, t_s, log_s)
    return rates


def _of_neighbours(turning: RotationSpline, t_s_N: Array, log_s_K: Array) -> Array:
    """Angular velocity (N, 3) of the parabola through a moment and the poses before and after it."""
    before = np.searchsorted(log_s_K, t_s_N - _SAME_TIME_NS * 1e-9, side="right") - 1
    after = np.searchsorted(log_s_K, t_s_N + _SAME_TIME_NS * 1e-9, side="left")
    both = (before >= 0) & (after < len(log_s_K))
    rate = np.full((len(t_s_N), 3), np.nan)
    here = turning(t_s_N[both])
    before_s, after_s = log_s_K[before[both]] - t_s_N[both], log_s_K[after[both]] - t_s_N[both]
    turns = [(here.inv() * turning(t_s_N[both] + dt)).as_rotvec() / dt[:, None] for dt in (before_s, after_s)]
    weight = (after_s / (after_s - before_s))[:, None]
    rate[both] = weight * turns[0] + (1 - weight) * turns[1]
    return rate
