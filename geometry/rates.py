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
    NaN where neither a pose before nor one after it is near enough. `angular_change` (N, 3) is the rate after the
    moment minus the rate before it: what the rates may be off by within it; NaN where one of them isn't known."""

    angular: Array
    velocity: Array
    angular_change: Array


def rates_at(
    t_ns_N: NDArray[np.int64],
    world_T_cam_N: Array,
    log_t_ns_K: NDArray[np.int64],
    log_world_T_cam_K: Array,
    gap_s: float,
) -> Rates:
    """Rates at times (N,) with poses (N, 4, 4), from a log's poses (K, 4, 4) at rising times (K,).

    The nearest pose before and the nearest after a moment count, each at most `gap_s` away: the derivative of the
    parabola through the three, or the rate to the one that is there.
    """
    sides = []
    for index in (
        np.searchsorted(log_t_ns_K, t_ns_N - _SAME_NS, side="right") - 1,
        np.searchsorted(log_t_ns_K, t_ns_N + _SAME_NS, side="left"),
    ):
        inside = (index >= 0) & (index < len(log_t_ns_K))
        other = log_world_T_cam_K[np.clip(index, 0, len(log_t_ns_K) - 1)]
        dt_s = (log_t_ns_K[np.clip(index, 0, len(log_t_ns_K) - 1)] - t_ns_N) * 1e-9
        near = inside & (np.abs(dt_s) <= gap_s)
        near &= np.isfinite(other[:, 0, 0]) & np.isfinite(world_T_cam_N[:, 0, 0])
        turn, move = np.full((len(t_ns_N), 3), np.nan), np.full((len(t_ns_N), 3), np.nan)
        cam_R_world = np.swapaxes(world_T_cam_N[near, :3, :3], 1, 2)
        turn[near] = Rotation.from_matrix(cam_R_world @ other[near, :3, :3]).as_rotvec() / dt_s[near, None]
        apart = other[near, :3, 3] - world_T_cam_N[near, :3, 3]
        move[near] = np.einsum("nij,nj->ni", cam_R_world, apart) / dt_s[near, None]
        sides.append((turn, move, np.where(near, np.abs(dt_s), np.nan)))
    (turn_b, move_b, dt_b), (turn_a, move_a, dt_a) = sides
    share = (dt_a / (dt_a + dt_b))[:, None]

    def joined(before: Array, after: Array) -> Array:
        both = share * before + (1 - share) * after
        return np.where(np.isfinite(both), both, np.where(np.isfinite(before), before, after))

    return Rates(joined(turn_b, turn_a), joined(move_b, move_a), turn_a - turn_b)
