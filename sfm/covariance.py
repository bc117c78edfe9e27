"""How well the images tie each camera's pose down: covariance of the bundle adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of all positions could take them away, which is what
remains when the model is aligned to something else.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from geometry.poses import Array
from sfm.normal_equations import block_rows, inverse_of, jacobians, reduced_camera_system, similarities

# The scatter of blobs tells that of the poses where there are some more of them than unknowns.
_POINTS_PER_UNKNOWN = 2


def pose_covariance(
    sfm_T_cam: Array,
    focal_N2: Array,
    xyz_P3: Array,
    frame_M: NDArray[np.int64],
    point_M: NDArray[np.int64],
    residual_px_M2: Array,
    loss_px: float,
    blob_P: NDArray[np.int64] | None = None,
) -> Array | None:
    """Covariance (N, 6, 6) of N adjusted poses, or None where there are too few points to tell.

    In the order rotation (rad, 3), position (sfm units, 3): true rotation = exp(rotation) @ sfm_R_cam, true position =
    position of sfm_T_cam + position, both along the sfm axes. `frame_M` and `point_M` say which pose sees which point;
    `loss_px` is the width of the Cauchy loss that the poses were adjusted with. `blob_P` numbers the blob of the images
    that each point is of (`Model.blobs`; a blob each without it). Intrinsics count as known.

    Nothing is assumed of the noise but that errors of two blobs have nothing to do with each other: those of one blob
    in the frames that see it hang together, as its features slide with the view, and points of one blob share them. So
    this is the sandwich of an M-estimator, clustered by blob (Huber 1967; Liang and Zeger, Biometrika 73, 1986; a
    point's residuals are scaled up for the three numbers that were fitted to them), brought to the gauge of all
    positions by an S-transformation (Baarda 1973).
    """
    frames, points = len(sfm_T_cam), len(xyz_P3)
    blob_P = np.arange(points) if blob_P is None else blob_P
    seen_by, blobs = np.bincount(point_M, minlength=points), int(blob_P.max(initial=-1)) + 1
    if blobs < _POINTS_PER_UNKNOWN * 6 * frames or seen_by.min() < 2:
        return None
    weight_M = 1 / (1 + np.sum(residual_px_M2**2, axis=1) / loss_px**2)
    by_pose, by_point = jacobians(sfm_T_cam, focal_N2, xyz_P3, frame_M, point_M)
    # The mean curvature of Cauchy's loss at a residual is its weight squared.
    try:
        system = reduced_camera_system(
            weight_M[:, None, None] * by_pose, weight_M[:, None, None] * by_point, frame_M, point_M, frames, points
        )
        inverse = inverse_of(system, similarities(sfm_T_cam[:, :3, 3]))
    except LinAlgError:
        return None
    fitted_M = np.sqrt(2 * seen_by / (2 * seen_by - 3))[point_M]
    force_M6 = _forces(by_pose, by_point, weight_M, fitted_M[:, None] * residual_px_M2, point_M, points)
    by_blob = block_rows(force_M6[:, :, None], frame_M, blob_P[point_M], frames, blobs)
    return _gauge_free_sandwich(inverse, (by_blob @ by_blob.T).toarray(), sfm_T_cam[:, :3, 3])


def _forces(
    by_pose: Array, by_point: Array, weight_M: Array, residual_M2: Array, point_M: NDArray[np.int64], points: int
) -> Array:
    """What each observation (M, 6) pulls its pose by when its point has given way as far as it would.

    Where an adjustment has converged the points pull nowhere; a few steps before that they do, and what that moves
    would count as the poses' own, the gauge included.
    """
    pull_M2 = weight_M[:, None] * residual_M2
    of_points = np.zeros((points, 3))
    np.add.at(of_points, point_M, np.einsum("mij,mi->mj", by_point, pull_M2))
    curved = (weight_M**2)[:, None, None] * by_point
    blocks = np.zeros((points, 3, 3))
    np.add.at(blocks, point_M, np.einsum("mij,mik->mjk", curved, by_point))
    moved_P3 = np.linalg.solve(blocks, of_points[:, :, None])[:, :, 0]
    return np.einsum("mij,mi->mj", by_pose, pull_M2 - np.einsum("mij,mj->mi", curved, moved_P3[point_M]))


def _gauge_free_sandwich(inverse: Array, middle: Array, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of inverse @ middle @ inverse where no similarity of all positions is left.

    S-transformation: X -> P X P^T with P = 1 - gauge (positions^T gauge)^-1 positions^T. Only its blocks are needed.
    """
    frames = len(position_N3)
    gauge_N67 = similarities(position_N3)
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
