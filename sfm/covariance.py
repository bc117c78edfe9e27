"""How well the images tie each camera's pose down: covariance of the bundle adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of all positions could take them away, which is what
remains when the model is aligned to something else.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, lapack
from scipy.sparse import bsr_array, csr_array

from geometry.poses import Array, skew

# The scatter of points tells that of the poses where there are some more of them than unknowns.
_POINTS_PER_UNKNOWN = 2


def pose_covariance(
    sfm_T_cam: Array,
    focal_N2: Array,
    xyz_P3: Array,
    frame_M: NDArray[np.int64],
    point_M: NDArray[np.int64],
    residual_px_M2: Array,
    loss_px: float,
) -> Array | None:
    """Covariance (N, 6, 6) of N adjusted poses, or None where there are too few points to tell.

    In the order rotation (rad, 3), position (sfm units, 3): true rotation = exp(rotation) @ sfm_R_cam, true position =
    position of sfm_T_cam + position, both along the sfm axes. `frame_M` and `point_M` say which pose sees which point;
    `loss_px` is the width of the Cauchy loss that the poses were adjusted with. Intrinsics count as known.

    Nothing is assumed of the noise but that errors of two points have nothing to do with each other: those of one point
    in the frames that see it hang together, as its features slide with the view. So this is the sandwich of an
    M-estimator, clustered by point (Huber 1967; Liang and Zeger, Biometrika 73, 1986; a point's residuals are scaled up
    for the three numbers that were fitted to them). The reduced camera system is the Schur complement of
    the normal equations (Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, section 6), the inverse is
    brought to the gauge of all positions by an S-transformation (Baarda 1973).
    """
    frames, points = len(sfm_T_cam), len(xyz_P3)
    seen_by = np.bincount(point_M, minlength=points)
    if points < _POINTS_PER_UNKNOWN * 6 * frames or seen_by.min() < 2:
        return None
    weight_M = 1 / (1 + np.sum(residual_px_M2**2, axis=1) / loss_px**2)
    by_pose, by_point = _jacobians(sfm_T_cam, focal_N2, xyz_P3, frame_M, point_M)
    # The mean curvature of Cauchy's loss at a residual is its weight squared.
    try:
        system = _reduced_camera_system(
            weight_M[:, None, None] * by_pose, weight_M[:, None, None] * by_point, frame_M, point_M, frames, points
        )
        inverse = _inverse(system, _gauge(sfm_T_cam[:, :3, 3]))
    except LinAlgError:
        return None
    fitted_M = np.sqrt(2 * seen_by / (2 * seen_by - 3))[point_M]
    force_M6 = np.einsum("mij,mi->mj", by_pose, (fitted_M * weight_M)[:, None] * residual_px_M2)
    by_track = _block_rows(force_M6[:, :, None], frame_M, point_M, frames, points)
    return _gauge_free_sandwich(inverse, (by_track @ by_track.T).toarray(), sfm_T_cam[:, :3, 3])


def _jacobians(
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


def _reduced_camera_system(
    by_pose: Array,
    by_point: Array,
    frame_M: NDArray[np.int64],
    point_M: NDArray[np.int64],
    frames: int,
    points: int,
) -> Array:
    pose_blocks = np.zeros((frames, 6, 6))
    np.add.at(pose_blocks, frame_M, np.swapaxes(by_pose, 1, 2) @ by_pose)
    point_blocks = np.zeros((points, 3, 3))
    np.add.at(point_blocks, point_M, np.swapaxes(by_point, 1, 2) @ by_point)
    # With V = L L^T the points' part of the Schur complement, W V^-1 W^T, is A A^T with A = W L^-T.
    factor = np.linalg.cholesky(point_blocks)[point_M]
    cross_blocks = np.swapaxes(by_pose, 1, 2) @ by_point
    a_blocks = np.swapaxes(np.linalg.solve(factor, np.swapaxes(cross_blocks, 1, 2)), 1, 2)
    a = _block_rows(a_blocks, frame_M, point_M, frames, points)
    system = -(a @ a.T).toarray()
    index = np.arange(frames)
    system.reshape(frames, 6, frames, 6)[index, :, index, :] += pose_blocks
    return system


def _block_rows(
    blocks: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64], frames: int, points: int
) -> csr_array:
    """Blocks (M, 6, k), one an observation, as a sparse (6 frames, k points) matrix."""
    order = np.lexsort((point_M, frame_M))
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    shape = (6 * frames, blocks.shape[2] * points)
    return bsr_array((blocks[order], point_M[order], starts), shape=shape).tocsr()


def _gauge(position_N3: Array) -> Array:
    """What a turn, a shift and a growth of the whole model about its middle do to each pose, (N, 6, 7)."""
    centred = position_N3 - position_N3.mean(axis=0)
    gauge = np.zeros((len(position_N3), 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = -skew(centred)
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, 3:, 6] = centred
    return gauge


def _inverse(system: Array, gauge_N67: Array) -> Array:
    """One of the inverses of `system` (6N, 6N), which is overwritten: its gauge is held in some way."""
    extent = float(np.sqrt(np.mean(gauge_N67[:, 3:, 6] ** 2) * 3))
    # The extent makes a turn comparable with a shift.
    held = (np.repeat([extent**2, 1.0], 3)[None, :, None] * gauge_N67).reshape(-1, 7)
    scale = np.trace(system) / np.sum(held**2)
    if not np.isfinite(system).all():
        raise LinAlgError("the reduced camera system has no numbers, as where a point lies in a camera's plane")
    triangle = cholesky(system + scale * held @ held.T, lower=True, overwrite_a=True)
    lower, info = lapack.dpotri(triangle, lower=True, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    return np.tril(lower) + np.tril(lower, -1).T


def _gauge_free_sandwich(inverse: Array, middle: Array, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of inverse @ middle @ inverse where no similarity of all positions is left.

    S-transformation: X -> P X P^T with P = 1 - gauge (positions^T gauge)^-1 positions^T. Only its blocks are needed.
    """
    frames = len(position_N3)
    gauge_N67 = _gauge(position_N3)
    positions_N67 = gauge_N67.copy()
    positions_N67[:, :3] = 0.0
    gauge, positions = gauge_N67.reshape(-1, 7), positions_N67.reshape(-1, 7)
    h = np.linalg.solve(positions.T @ gauge, positions.T)
    left = inverse @ middle
    blocks = left.reshape(frames, 6, -1) @ np.swapaxes(inverse.reshape(-1, frames, 6), 0, 1)
    of_h = left @ (inverse @ h.T)
    gauge_T = np.swapaxes(gauge_N67, 1, 2)
    cross = of_h.reshape(frames, 6, 7) @ gauge_T
    return blocks - cross - np.swapaxes(cross, 1, 2) + gauge_N67 @ (h @ of_h) @ gauge_T
