"""The drifting alignment as a chain: least squares over the camera's map poses at all keyframes at once.

Odometry and map share their vertical, so what is unknown at keyframe i is the camera's map position c_i (3,) and the
yaw of map_R_vio, theta_i. Two kinds of terms bind them:

- odometry's drift is a random walk: theta_i - theta_(i-1) - t_i and c_i - c_(i-1) - R(theta_(i-1)) s_i are zero up to
  variances that grow with the way between them. s_i is odometry's step and t_i is 0, but where odometry's frame was
  lost and bridged;
- a prediction is the pose up to an error, normalised and in camera axes (prediction_noise.py): r_i = B_i
  [rotation error, position error], both in the map's axes turned back by theta_i.

Increments are in those turned axes, too: (x, y, z, yaw), shape (N, 4). There the Jacobians of predictions hang on no
yaw, and each term touches two neighbours at most: the normal equations are banded, and a step costs O(N)."""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array

# Of the six numbers of an error: those that the unknowns (x, y, z, yaw) change.
UNKNOWN = [3, 4, 5, 1]
_BAND = 7
_ROWS = 4 + 4 + 3  # of the blocks below: diagonal, subdiagonal, and zeros to read beyond them


class Chain(NamedTuple):
    """What odometry says: `step` (N, 3), `turn` (N,) and `precision` (N, 4) of x, y, z and yaw from the keyframe before
    (horizontal ones equal); row 0 and rows of precision 0 are bound to nothing before them."""

    step: Array
    turn: Array
    precision: Array


class Solution(NamedTuple):
    """Increments (N, 4) and the Cholesky factor of the information (banded, LAPACK's lower storage)."""

    increments: Array
    factor: Array

    def covariance(self, index: int) -> Array:
        """Covariance (4, 4) of one keyframe's increments."""
        count = len(self.increments)
        if index == count - 1:
            # Nothing comes after it: its block of the factor is all that its covariance hangs on.
            block = np.zeros((4, 4))
            for column in range(4):
                block[column:, column] = self.factor[: 4 - column, 4 * index + column]
            inverse = np.linalg.inv(block)
            return np.asarray(inverse.T @ inverse)
        return self.covariances(np.array([index]))[0]

    def covariances(self, rows: NDArray[np.int64]) -> Array:
        """Covariances (K, 4, 4) of some keyframes' increments."""
        columns = self.columns(rows).reshape(-1, 4, len(rows), 4)
        return np.asarray(columns[rows, :, np.arange(len(rows))])

    def columns(self, rows: NDArray[np.int64]) -> Array:
        """The columns (4N, 4K) of the inverse of the information that are some keyframes'."""
        unit = np.zeros((4 * len(self.increments), 4 * len(rows)), order="F")
        at = np.arange(4)
        unit[(4 * rows[:, None] + at).ravel(), np.arange(4 * len(rows))] = 1.0
        return np.asarray(dpbtrs(self.factor, unit, lower=1, overwrite_b=1)[0])


def errors(position: Array, yaw: Array, measured_position: Array, measured_yaw: Array, tilt: Array) -> Array:
    """Errors of predictions (N, 6), rotation (rad) before position, in map axes turned back by the yaw.

    position (N, 3) and yaw (N,): the chain's; measured_yaw (N,): that of the predicted rotation against odometry's;
    tilt (N, 2): the rest of that rotation, about the map's x and z. What is 2 pi apart is the same yaw.
    """
    c, s = np.cos(yaw), np.sin(yaw)
    apart = measured_position - position
    error = np.empty((len(apart), 6))
    error[:, 0] = c * tilt[:, 0] - s * tilt[:, 1]
    error[:, 1] = (measured_yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    error[:, 2] = s * tilt[:, 0] + c * tilt[:, 1]
    error[:, 3] = c * apart[:, 0] - s * apart[:, 2]
    error[:, 4] = apart[:, 1]
    error[:, 5] = s * apart[:, 0] + c * apart[:, 2]
    return error


def solve(chain: Chain, position: Array, yaw: Array, information: Array, gradient: Array) -> Solution:
    """One Gauss-Newton step. `information` (N, 4, 4) and `gradient` (N, 4) are the predictions'.

    Raises GeometryError where nothing binds some keyframe.
    """
    count = len(yaw)
    blocks = np.zeros((count, _ROWS, 4))
    diagonal = blocks[:, :4]
    diagonal[:] = information
    right = gradient.copy()
    if count > 1:
        q = chain.precision[1:]
        c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
        moved = position[1:] - position[:-1]
        turned = yaw[1:] - yaw[:-1]
        # The steps between positions, turned back by the yaw before; e is what odometry's leave of them, and yaw's.
        dx, dz = c * moved[:, 0] - s * moved[:, 2], s * moved[:, 0] + c * moved[:, 2]
        e = np.empty((count - 1, 4))
        e[:, 0], e[:, 1], e[:, 2], e[:, 3] = dx, moved[:, 1], dz, turned
        e[:, :3] -= chain.step[1:]
        e[:, 3] -= chain.turn[1:]
        weighted = q * e
        horizontal = q[:, 0]
        # A yaw before turns the step: d(step)/d(yaw) = (dz, 0, -dx), and turns the increments after it.
        bent_x, bent_z = horizontal * dz, -horizontal * dx
        diagonals = blocks.reshape(count, -1)[:, :16:5]  # a view of the diagonal blocks' diagonals
        diagonals[1:] += q
        diagonals[:-1] += q
        diagonal[:-1, 0, 3] += bent_x
        diagonal[:-1, 3, 0] += bent_x
        diagonal[:-1, 2, 3] += bent_z
        diagonal[:-1, 3, 2] += bent_z
        diagonal[:-1, 3, 3] += bent_x * dz - bent_z * dx
        right[:-1] += weighted
        right[:-1, 3] += weighted[:, 0] * dz - weighted[:, 2] * dx
        ct, st = np.cos(turned), np.sin(turned)
        right[1:, 0] -= ct * weighted[:, 0] - st * weighted[:, 2]
        right[1:, 1] -= weighted[:, 1]
        right[1:, 2] -= st * weighted[:, 0] + ct * weighted[:, 2]
        right[1:, 3] -= weighted[:, 3]
        below = blocks[:-1, 4:8]
        below[:, 0, 0] = below[:, 2, 2] = -ct * horizontal
        below[:, 0, 2] = st * horizontal
        below[:, 2, 0] = -st * horizontal
        below[:, 1, 1], below[:, 3, 3] = -q[:, 1], -q[:, 3]
        below[:, 0, 3] = -(ct * bent_x - st * bent_z)
        below[:, 2, 3] = -(st * bent_x + ct * bent_z)
    factor, fault = dpbtrf(_banded(blocks), lower=1)
    if fault:
        raise GeometryError(f"nothing binds keyframe {(fault - 1) // 4} of {count}: the information isn't positive")
    return Solution(dpbtrs(factor, right.ravel(), lower=1)[0].reshape(count, 4), factor)


def applied(position: Array, yaw: Array, increments: Array) -> tuple[Array, Array]:
    """Position (N, 3) and yaw (N,) after increments (N, 4)."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z, turn = increments.T
    moved = np.empty((len(yaw), 3))
    moved[:, 0], moved[:, 1], moved[:, 2] = c * x + s * z, y, c * z - s * x
    return position + moved, yaw + turn


def _banded(blocks: Array) -> Array:
    """LAPACK's lower band storage (8, 4N), in Fortran order, of diagonal and subdiagonal blocks (N, 11, 4)."""
    count = len(blocks)
    block, row, column = blocks.strides
    view = as_strided(blocks, (count, 4, _BAND + 1), (block, row + column, row), writeable=False)
    return np.asarray(view.reshape(4 * count, _BAND + 1).T)
