"""The drifting alignment as a chain: least squares over the camera's map poses at all keyframes at once.

Odometry and map share their vertical, so what is unknown at keyframe i is the camera's map position c_i (3,) and the
yaw of map_R_vio, theta_i: a state (4,). Two kinds of terms bind them:

- odometry's drift is a random walk: theta_i - theta_(i-1) - t_i and c_i - c_(i-1) - R(theta_(i-1)) s_i are zero up to
  variances that grow with the way between them. s_i is odometry's step and t_i is 0, but where odometry's frame was
  lost and bridged;
- a prediction is the pose up to an error, normalised and in camera axes (error_covariance.py): r_i = B_i
  [rotation error, position error], both in the map's axes turned back by theta_i.

Increments are in those turned axes, too: (x, y, z, yaw), shape (N, 4). There the Jacobians of predictions hang on no
yaw, and each term touches two neighbours at most: the normal equations are block tridiagonal, and a step costs O(N)."""

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import add_product, clear, compiled, invert
from groundwalk.geometry.poses import Array

# Of the six numbers of an error: those that the unknowns (x, y, z, yaw) change.
UNKNOWN = (3, 4, 5, 1)


class Chain(NamedTuple):
    """What odometry says: `step` (N, 3), `turn` (N,) and `precision` (N, 4) of x, y, z and yaw from the keyframe before
    (horizontal ones equal); row 0 and rows of precision 0 are bound to nothing before them."""

    step: Array
    turn: Array
    precision: Array


class Solution(NamedTuple):
    """Increments (N, 4) and the covariances of each (N, 4, 4).

    gain (N, 4, 4): by what an increment follows the next one's, in the inverse of the information as well.
    """

    increments: Array
    covariance: Array
    gain: Array


@compiled
def write_error(state: Array, measured: Array, error: Array) -> None:
    """Writes a prediction's error (6,), rotation (rad) before position, in map axes turned back by the state's yaw.

    measured (6,): position, yaw against odometry's, and the rest of the predicted rotation, about the map's x and z.
    What is 2 pi apart is the same yaw.
    """
    c, s = cos(state[3]), sin(state[3])
    x, z = measured[0] - state[0], measured[2] - state[2]
    error[0] = c * measured[4] - s * measured[5]
    error[1] = (measured[3] - state[3] + pi) % (2 * pi) - pi
    error[2] = s * measured[4] + c * measured[5]
    error[3] = c * x - s * z
    error[4] = measured[1] - state[1]
    error[5] = s * x + c * z


@compiled
def solve(chain: Chain, state: Array, information: Array, gradient: Array) -> Solution:
    """One Gauss-Newton step at states (N, 4). `information` (N, 4, 4) and `gradient` (N, 4) are the predictions'."""
    count = len(state)
    covariance, right = information.copy(), gradient.copy()
    gain, below, moved = np.zeros((count, 4, 4)), np.zeros((4, 4)), np.empty((4, 4))
    increments = np.zeros((count, 4))
    for i in range(count):
        after = i + 1
        if after < count:
            _bind(chain, state, i, covariance, right, below)
        invert(covariance[i])
        if after < count:
            add_product(below, covariance[i], gain[i], (4, 4, 4))
            add_product(gain[i], below.T, covariance[after], (4, 4, 4), -1.0)
            for j in range(4):
                for k in range(4):
                    right[after, j] -= gain[i, j, k] * right[i, k]
    # So far these are covariances without what comes after.
    for i in range(count - 1, -1, -1):
        for j in range(4):
            for k in range(4):
                increments[i, j] += covariance[i, j, k] * right[i, k]
        if i + 1 < count:
            clear(moved, 4, 4)
            add_product(covariance[i + 1], gain[i], moved, (4, 4, 4))
            add_product(gain[i].T, moved, covariance[i], (4, 4, 4))
            for j in range(4):
                for k in range(4):
                    increments[i, j] -= gain[i, k, j] * increments[i + 1, k]
    return Solution(increments, covariance, gain)


@compiled
def _bind(chain: Chain, state: Array, i: int, diagonal: Array, right: Array, below: Array) -> None:
    """Add what odometry says between keyframe i and the next: to their diagonal blocks (N, 4, 4) and right sides
    (N, 4); writes the block below the diagonal (4, 4)."""
    j = i + 1
    q = chain.precision[j]
    c, s = cos(state[i, 3]), sin(state[i, 3])
    x, y, z, turned = (
        state[j, 0] - state[i, 0],
        state[j, 1] - state[i, 1],
        state[j, 2] - state[i, 2],
        state[j, 3] - state[i, 3],
    )
    # The step, turned back by the yaw before; w is what odometry's leaves of it, and of the yaw's, weighed.
    dx, dz = c * x - s * z, s * x + c * z
    w_x, w_y, w_z = q[0] * (dx - chain.step[j, 0]), q[1] * (y - chain.step[j, 1]), q[2] * (dz - chain.step[j, 2])
    w_yaw = q[3] * (turned - chain.turn[j])
    # A yaw before turns the step: d(step)/d(yaw) = (dz, 0, -dx), and turns the increments after it.
    bent_x, bent_z = q[0] * dz, -q[0] * dx
    for k in range(4):
        diagonal[i, k, k] += q[k]
        diagonal[j, k, k] += q[k]
    diagonal[i, 0, 3] += bent_x
    diagonal[i, 3, 0] += bent_x
    diagonal[i, 2, 3] += bent_z
    diagonal[i, 3, 2] += bent_z
    diagonal[i, 3, 3] += bent_x * dz - bent_z * dx
    right[i, 0] += w_x
    right[i, 1] += w_y
    right[i, 2] += w_z
    right[i, 3] += w_yaw + w_x * dz - w_z * dx
    c, s = cos(turned), sin(turned)
    right[j, 0] -= c * w_x - s * w_z
    right[j, 1] -= w_y
    right[j, 2] -= s * w_x + c * w_z
    right[j, 3] -= w_yaw
    below[0, 0] = below[2, 2] = -c * q[0]
    below[0, 2], below[2, 0] = s * q[0], -s * q[0]
    below[1, 1], below[3, 3] = -q[1], -q[3]
    below[0, 3], below[2, 3] = s * bent_z - c * bent_x, -s * bent_x - c * bent_z


@compiled
def covariances_with(solution: Solution, index: int) -> Array:
    """Covariances (N, 4, 4) of all increments with the `index`th one."""
    count = len(solution.covariance)
    of, passed, back = np.zeros((count, 4, 4)), np.zeros((4, 4)), np.empty((4, 4))
    for j in range(4):
        passed[j, j] = 1.0
    add_product(solution.covariance[index], passed, of[index], (4, 4, 4))
    for i in range(index - 1, -1, -1):
        add_product(solution.gain[i].T, of[i + 1], of[i], (4, 4, 4), -1.0)
    for i in range(index + 1, count):
        clear(back, 4, 4)
        add_product(solution.gain[i - 1], passed, back, (4, 4, 4), -1.0)
        passed, back = back, passed
        add_product(solution.covariance[i], passed, of[i], (4, 4, 4))
    return of


@compiled
def apply(state: Array, increments: Array) -> None:
    """Move states (N, 4) by increments (N, 4)."""
    for i in range(len(state)):
        c, s = cos(state[i, 3]), sin(state[i, 3])
        x, z = increments[i, 0], increments[i, 2]
        state[i, 0] += c * x + s * z
        state[i, 1] += increments[i, 1]
        state[i, 2] += c * z - s * x
        state[i, 3] += increments[i, 3]
