"""The most probable chain of poses, each measured by itself and against its neighbour."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, inverse, relative, skew

_MAX_ITERATIONS = 20
_TOLERANCE = 1e-7


def inverse_right_jacobian(rotation_vector: ArrayLike) -> Array:
    """J (..., 3, 3) with log(exp(v) exp(w)) = v + J w for small w (Chirikjian, "Stochastic Models, Information Theory,
    and Lie Groups" 2, 2012, eq. 10.86), for rotation vectors v (..., 3) shorter than half a turn."""
    v = np.asarray(rotation_vector, dtype=float)
    angle = np.linalg.norm(v, axis=-1)
    large = angle > 1e-4
    safe = np.where(large, angle, 1.0)
    k = np.where(large, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)), 1 / 12)
    cross = skew(v)
    return np.eye(3) + cross / 2 + k[..., None, None] * (cross @ cross)


def smooth_chain(
    measured: ArrayLike,
    steps: ArrayLike,
    start: ArrayLike,
    *,
    measured_sd: tuple[float, float],
    step_sd: tuple[float, float],
    huber: float = np.inf,
) -> tuple[Array, Array]:
    """The poses (N, 4, 4) that fit measured poses (N, 4, 4) and steps a_T_b (N-1, 4, 4) between neighbours best, and
    the covariance (6, 6) of the last: rotation (rad, camera axes), then position (m, the measurements' frame).

    Least squares over rotation and position differences, weighted by standard deviations (m, rad); Gauss-Newton from
    `start` (N, 4, 4). A measurement that is off by more than `huber` standard deviations counts with Huber's weight.
    """
    z, d, poses = (np.asarray(x, dtype=float) for x in (measured, steps, start))
    n = len(z)
    poses = poses.copy()
    normal = np.zeros((12, 6 * n))
    for _ in range(_MAX_ITERATIONS):
        own, g = _of_measurements(z, poses, measured_sd, huber)
        below = _add_steps(own, g, d, poses, step_sd)
        for column in range(6):  # the lower diagonals, as solveh_banded takes them
            normal[: 6 - column, column::6] = own[:, column:, column].T
            normal[6 - column : 12 - column, column : 6 * (n - 1) : 6] = below[:, :, column].T
        update = -solveh_banded(normal, g.ravel(), lower=True).reshape(n, 6)
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(update[:, :3]).as_matrix()
        poses[:, :3, 3] += update[:, 3:]
        if np.abs(update).max() < _TOLERANCE:
            break
    last = np.zeros((6 * n, 6))
    last[-6:] = np.eye(6)
    return poses, np.asarray(solveh_banded(normal, last, lower=True)[-6:], dtype=float)


def _of_measurements(measured: Array, poses: Array, sd: tuple[float, float], huber: float) -> tuple[Array, Array]:
    """What measured poses add to the normal equations: blocks (N, 6, 6) and right side (N, 6) by frame, rotation
    (camera axes) before position."""
    n = len(poses)
    turn = Rotation.from_matrix(measured[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, :3]).as_rotvec()
    J = inverse_right_jacobian(turn)
    off = poses[:, :3, 3] - measured[:, :3, 3]
    sds = np.sqrt((turn**2).sum(axis=1) / sd[1] ** 2 + (off**2).sum(axis=1) / sd[0] ** 2)
    weight = np.minimum(1.0, huber / np.maximum(sds, 1e-12))
    own, g = np.zeros((n, 6, 6)), np.zeros((n, 6))
    own[:, :3, :3] = weight[:, None, None] * (J.swapaxes(1, 2) @ J) / sd[1] ** 2
    own[:, 3:, 3:] = weight[:, None, None] * np.eye(3) / sd[0] ** 2
    g[:, :3] = weight[:, None] * np.einsum("nij,ni->nj", J, turn) / sd[1] ** 2
    g[:, 3:] = weight[:, None] * off / sd[0] ** 2
    return own, g


def _add_steps(own: Array, g: Array, steps: Array, poses: Array, sd: tuple[float, float]) -> Array:
    """Add what steps (N-1, 4, 4) between neighbours say to each frame's own block (N, 6, 6) and the right side; the
    blocks (N-1, 6, 6) of a frame (columns) and the next (rows)."""
    n = len(poses)
    step = relative(poses[:-1], poses[1:])
    turn = Rotation.from_matrix((inverse(steps) @ step)[:, :3, :3]).as_rotvec()
    off = step[:, :3, 3] - steps[:, :3, 3]
    to_a = poses[:-1, :3, :3].swapaxes(1, 2)
    A, B = np.zeros((n - 1, 6, 6)), np.zeros((n - 1, 6, 6))
    J = inverse_right_jacobian(turn)
    A[:, :3, :3] = -J @ step[:, :3, :3].swapaxes(1, 2)
    A[:, 3:, :3], A[:, 3:, 3:] = skew(step[:, :3, 3]), -to_a
    B[:, :3, :3], B[:, 3:, 3:] = J, to_a
    information = np.repeat([sd[1] ** -2.0, sd[0] ** -2.0], 3)
    residual = np.concatenate([turn, off], axis=1) * information
    At, Bt = A.swapaxes(1, 2) * information, B.swapaxes(1, 2) * information
    own[:-1] += At @ A
    own[1:] += Bt @ B
    g[:-1] += np.einsum("nij,ni->nj", A, residual)
    g[1:] += np.einsum("nij,ni->nj", B, residual)
    return Bt @ A
