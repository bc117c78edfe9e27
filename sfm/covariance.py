"""How well the images tie each camera's pose down: covariance of the bundle adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of the whole model could take them away, which is what
remains when the model is aligned to something else.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, lapack
from scipy.sparse import bsr_array

from geometry.poses import Array


def pose_covariance(
    sfm_T_cam: Array,
    focal_N2: Array,
    xyz_P3: Array,
    frame_M: NDArray[np.int64],
    point_M: NDArray[np.int64],
    residual_px_M2: Array,
) -> Array | None:
    """Covariance (N, 6, 6) of N adjusted poses, or None where the observations don't determine them.

    In the order rotation (rad, 3), position (sfm units, 3): true rotation = exp(rotation) @ sfm_R_cam, true position =
    position of sfm_T_cam + position, both along the sfm axes. `frame_M` and `point_M` say which pose sees which point;
    intrinsics count as known, observations as independent, with the variance that the residuals show.

    The reduced camera system is the Schur complement of the normal equations (Triggs et al., "Bundle Adjustment - A
    Modern Synthesis", 2000, section 6), its inverse brought to inner constraints by an S-transformation (Baarda 1973).
    """
    frames, points, observations = len(sfm_T_cam), len(xyz_P3), len(frame_M)
    freedom = 2 * observations - 6 * frames - 3 * points + 7
    if freedom <= 0:
        return None
    variance_px2 = float(np.sum(residual_px_M2**2)) / freedom
    try:
        system = _reduced_camera_system(sfm_T_cam, focal_N2, xyz_P3, frame_M, point_M)
        blocks = _gauge_free_inverse(system, sfm_T_cam[:, :3, 3])
    except LinAlgError:
        return None
    return variance_px2 * blocks


def _reduced_camera_system(
    sfm_T_cam: Array, focal_N2: Array, xyz_P3: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64]
) -> Array:
    frames, points = len(sfm_T_cam), len(xyz_P3)
    cam_R_sfm = np.swapaxes(sfm_T_cam[:, :3, :3], 1, 2)[frame_M]
    offset = xyz_P3[point_M] - sfm_T_cam[frame_M, :3, 3]
    x, y, z = np.einsum("mij,mj->im", cam_R_sfm, offset)
    fx, fy = focal_N2[frame_M].T
    zero = np.zeros_like(z)
    pixel_by_xyz = np.stack(
        [np.stack([fx / z, zero, -fx * x / z**2], -1), np.stack([zero, fy / z, -fy * y / z**2], -1)], 1
    )
    by_point = pixel_by_xyz @ cam_R_sfm
    by_pose = np.concatenate([by_point @ _cross(offset), -by_point], axis=2)

    pose_blocks = np.zeros((frames, 6, 6))
    np.add.at(pose_blocks, frame_M, np.swapaxes(by_pose, 1, 2) @ by_pose)
    point_blocks = np.zeros((points, 3, 3))
    np.add.at(point_blocks, point_M, np.swapaxes(by_point, 1, 2) @ by_point)
    # With V = L L^T the points' part of the Schur complement, W V^-1 W^T, is A A^T with A = W L^-T.
    factor = np.linalg.cholesky(point_blocks)[point_M]
    cross_blocks = np.swapaxes(by_pose, 1, 2) @ by_point
    a_blocks = np.swapaxes(np.linalg.solve(factor, np.swapaxes(cross_blocks, 1, 2)), 1, 2)

    order = np.lexsort((point_M, frame_M))
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    a = bsr_array((a_blocks[order], point_M[order], starts), shape=(6 * frames, 3 * points)).tocsr()
    system = -(a @ a.T).toarray()
    index = np.arange(frames)
    system.reshape(frames, 6, frames, 6)[index, :, index, :] += pose_blocks
    return system


def _gauge_free_inverse(system: Array, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of the inverse of `system` (6N, 6N) in the gauge of the poses as a whole."""
    frames = len(position_N3)
    centred = position_N3 - position_N3.mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum(centred**2, axis=1))))
    # What a turn, a shift and a growth of the whole model do to each pose.
    gauge_N67 = np.zeros((frames, 6, 7))
    gauge_N67[:, :3, :3] = np.eye(3)
    gauge_N67[:, 3:, :3] = -_cross(centred)
    gauge_N67[:, 3:, 3:6] = np.eye(3)
    gauge_N67[:, 3:, 6] = centred
    # The extent makes a turn comparable with a shift.
    weight = np.repeat([extent**2, 1.0], 3)[None, :, None]
    gauge, weighted = gauge_N67.reshape(-1, 7), (weight * gauge_N67).reshape(-1, 7)

    scale = np.trace(system) / np.sum(weighted**2)
    triangle = cholesky(system + scale * weighted @ weighted.T, lower=True, overwrite_a=True)
    lower, info = lapack.dpotri(triangle, lower=True, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    inverse = np.tril(lower) + np.tril(lower, -1).T
    # S-transformation: X -> P X P^T with P = 1 - gauge (weighted^T gauge)^-1 weighted^T. Only its blocks are needed.
    h = np.linalg.solve(weighted.T @ gauge, weighted.T)
    inverse_h = (inverse @ h.T).reshape(frames, 6, 7)
    gauge_T = np.swapaxes(gauge_N67, 1, 2)
    index = np.arange(frames)
    blocks = inverse.reshape(frames, 6, frames, 6)[index, :, index, :]
    cross = inverse_h @ gauge_T
    return blocks - cross - np.swapaxes(cross, 1, 2) + gauge_N67 @ (h @ inverse @ h.T) @ gauge_T


def _cross(v: Array) -> Array:
    """[v]x (..., 3, 3) with [v]x w = v x w."""
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
