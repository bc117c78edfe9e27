"""Angular velocity and velocity of a camera from poses around a moment."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.poses import Array

_SAME_NS = 1_000_000


@dataclass(frozen=True)
class Rates:
    """Of N moments: angular velocity (N, 3), rad/s, and velocity (N, 3), m/s, in the axes of the camera at that moment;
    NaN where no pose before or after it is near enough. `angular_change` and `velocity_change` (N, 3) are the rate
    after the moment minus the rate before it: what the rates may be off by within it."""

    angular: Array
    velocity: Array
    angular_change: Array
    velocity_change: Array


def rates_at(
    t_ns_N: NDArray[np.int64],
    world_T_cam_N: Array,
    log_t_ns_K: NDArray[np.int64],
    log_world_T_cam_K: Array,
    gap_s: float,
) -> Rates:
    """Rates at times (N,) with poses (N, 4, 4), from a log's poses (K, 4, 4) at rising times (K,).

    The nearest pose before and the nearest after a moment count, each at most `gap_s` away: the derivative of the
    parabola through the three.
    """
    before = np.searchsorted(log_t_ns_K, t_ns_N - _SAME_NS, side="right") - 1
    after = np.searchsorted(log_t_ns_K, t_ns_N + _SAME_NS, side="left")
    inside = (before >= 0) & (after < len(log_t_ns_K)) & np.isfinite(world_T_cam_N[:, 0, 0])
    b, a = np.clip(before, 0, None), np.clip(after, None, len(log_t_ns_K) - 1)
    h_b, h_a = (t_ns_N - log_t_ns_K[b]) * 1e-9, (log_t_ns_K[a] - t_ns_N) * 1e-9
    finite = np.isfinite(log_world_T_cam_K[b, 0, 0]) & np.isfinite(log_world_T_cam_K[a, 0, 0])
    known = inside & finite & (h_b <= gap_s) & (h_a <= gap_s)
    angular, velocity, angular_change, velocity_change = (np.full((len(t_ns_N), 3), np.nan) for _ in range(4))
    if known.any():
        now, h_b, h_a = world_T_cam_N[known], h_b[known, None], h_a[known, None]
        cam_R_world = np.swapaxes(now[:, :3, :3], 1, 2)
        sides = []
        for other, h in ((log_world_T_cam_K[b[known]], -h_b), (log_world_T_cam_K[a[known]], h_a)):
            turn = Rotation.from_matrix(cam_R_world @ other[:, :3, :3]).as_rotvec() / h
            move = np.einsum("nij,nj->ni", cam_R_world, other[:, :3, 3] - now[:, :3, 3]) / h
            sides.append((turn, move))
        share = h_a / (h_a + h_b)
        (turn_b, move_b), (turn_a, move_a) = sides
        angular[known] = share * turn_b + (1 - share) * turn_a
        velocity[known] = share * move_b + (1 - share) * move_a
        angular_change[known], velocity_change[known] = turn_a - turn_b, move_a - move_b
    return Rates(angular, velocity, angular_change, velocity_change)
