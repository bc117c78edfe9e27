"""The normal equations of a bundle adjustment, and the poses' part of them without the points.

The reduced camera system is the Schur complement of the normal equations (Triggs et al., "Bundle Adjustment - A Modern
Synthesis", 2000, section 6). A pose's errors are a rotation (rad, 3) and a position (sfm units, 3) along the sfm axes:
true rotation = exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, lapack
from scipy.sparse import bsr_array

from geometry.poses import Array, skew


def jacobians(
    sfm_T_cam: Array, focal_N2: Array, xyz_P3: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64]
) -> tuple[Array, Array]:
    """How each observation's pixel moves with its pose's errors, (M, 2, 6), and with its point, (M, 2, 3)."""
    cam_R_sfm = np.swapaxes(sfm_T_cam[:, :3, :3], 1, 2)[frame_M]
    offset = xyz_P3[point_M] - sfm_T_cam[frame_M, :3, 3]
    x, y, z = np.einsum("mij,mj->im", cam_R_sfm, offset)
    fx, fy = focal_N2[frame_M].T
    zero = np.zeros_like(z)
    pixel_by_xyz = np.stack(
        [np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1
    )
    by_point = pixel_by_xyz @ cam_R_sfm
    return np.concatenate([by_point @ skew(offset), -by_point], axis=2), by_point


def reduced_camera_system(
    by_pose: Array,
    by_point: Array,
    frame_M: NDArray[np.int64],
    point_M: NDArray[np.int64],
    frames: int,
    points: int,
) -> Array:
    """What is left of the normal equations without the points, (6 frames, 6 frames)."""
    pose_blocks = np.zeros((frames, 6, 6))
    np.add.at(pose_blocks, frame_M, np.swapaxes(by_pose, 1, 2) @ by_pose)
    point_blocks = np.zeros((points, 3, 3))
    np.add.at(point_blocks, point_M, np.swapaxes(by_point, 1, 2) @ by_point)
    # With V = L L^T the points' part of the Schur complement, W V^-1 W^T, is A A^T with A = W L^-T.
    factor = np.linalg.cholesky(point_blocks)[point_M]
    cross_blocks = np.swapaxes(by_pose, 1, 2) @ by_point
    a_blocks = np.swapaxes(np.linalg.solve(factor, np.swapaxes(cross_blocks, 1, 2)), 1, 2)
    a = block_rows(a_blocks, frame_M, point_M, frames, points)
    system = -(a @ a.T).toarray()
    index = np.arange(frames)
    system.reshape(frames, 6, frames, 6)[index, :, index, :] += pose_blocks
    return system


def block_rows(
    blocks: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64], frames: int, points: int
) -> bsr_array:
    """Blocks (M, 6, k), one an observation, as a sparse (6 frames, k points) matrix of blocks: products of such are
    three times as fast as of single numbers."""
    order = np.lexsort((point_M, frame_M))
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    shape = (6 * frames, blocks.shape[2] * points)
    return bsr_array((blocks[order], point_M[order], starts), shape=shape)


def similarities(position_N3: Array) -> Array:
    """What a turn, a shift and a growth of the whole model about its middle do to each pose, (N, 6, 7)."""
    centred = position_N3 - position_N3.mean(axis=0)
    gauge = np.zeros((len(position_N3), 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = -skew(centred)
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, 3:, 6] = centred
    return gauge


def inverse_of(system: Array, gauge_N67: Array) -> Array:
    """One of the inverses of `system` (6N, 6N), which is overwritten: its gauge is held in some way."""
    triangle = factor_of(system, gauge_N67)
    lower, info = lapack.dpotri(triangle, lower=True, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    return np.tril(lower) + np.tril(lower, -1).T


def factor_of(system: Array, gauge_N67: Array) -> Array:
    """The lower Cholesky factor of `system` (6N, 6N), which is overwritten, with its gauge held in some way."""
    extent = float(np.sqrt(np.mean(gauge_N67[:, 3:, 6] ** 2) * 3))
    # The extent makes a turn comparable with a shift.
    held = (np.repeat([extent**2, 1.0], 3)[None, :, None] * gauge_N67).reshape(-1, 7)
    scale = np.trace(system) / np.sum(held**2)
    if not np.isfinite(system).all():
        raise LinAlgError("the reduced camera system has no numbers, as where a point lies in a camera's plane")
    return cholesky(system + scale * held @ held.T, lower=True, overwrite_a=True)
