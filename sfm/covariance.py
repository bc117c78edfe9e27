"""How well the images tie each camera's pose down: covariance of the adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of all positions could take them away, which is what
remains when the model is aligned to something else. Lens, readout, focal lengths and angular velocities are unknowns
with priors, as in the adjustment, and their uncertainty is part of the poses'.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cholesky, lapack
from scipy.sparse import csr_array, vstack

from geometry.poses import Array
from sfm.adjustment import (
    Adjusted,
    Ints,
    Linearized,
    add_information,
    hold_gauge,
    linearize,
    local_unknowns,
    loss_variance,
    normal_equations,
    prior_information,
    shared_columns,
    summed,
)
from sfm.normal_equations import block_rows, similarities

# The scatter of blobs tells that of the poses where there are some more of them than unknowns.
_POINTS_PER_UNKNOWN = 2


@dataclass(frozen=True)
class Covariances:
    """Of an adjusted model's frames (N, 6, 6), in the order rotation (rad, 3), position (sfm units, 3): true rotation =
    exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position, both along the sfm axes; and of what
    the frames share (G, G): k1, k2 and readout of each lens, then each session's log focal factor."""

    poses: Array
    shared: Array


def covariances(adjusted: Adjusted, blob_P: Ints) -> Covariances | None:
    """None where there are too few points to tell. `blob_P` numbers the blob of the images that each point is of.

    Nothing is assumed of the noise but that errors of two blobs have nothing to do with each other: those of one blob
    in the frames that see it hang together, as its features slide with the view, and points of one blob share them. So
    this is the sandwich of an M-estimator, clustered by blob (Huber 1967; Liang and Zeger, Biometrika 73, 1986; a
    point's residuals are scaled up for the three numbers that were fitted to them), brought to the gauge of all
    positions by an S-transformation (Baarda 1973).
    """
    scene, cameras = adjusted.scene, adjusted.cameras
    frames, points = len(scene.sfm_T_cam), len(scene.xyz)
    seen_by = np.bincount(scene.point, minlength=points)
    blobs = int(blob_P.max(initial=-1)) + 1
    if blobs < _POINTS_PER_UNKNOWN * 6 * frames or seen_by.min() < 2:
        return None
    linear = linearize(scene, cameras)
    weight = 1 / (1 + np.sum(linear.residual**2, axis=1) / adjusted.loss_px**2)
    variance = loss_variance(adjusted.loss_px)
    information = prior_information(cameras, adjusted.priors)
    # The mean curvature of Cauchy's loss at a residual is its weight squared.
    matrix = add_information(normal_equations(scene, cameras, linear, weight**2).matrix, variance * information)
    hold_gauge(matrix, scene.sfm_T_cam[:, :3, 3])
    try:
        inverse = _inverse(matrix)
    except LinAlgError:
        return None
    fitted = np.sqrt(2 * seen_by / np.maximum(2 * seen_by - 3, 1))[scene.point]
    force = _forces(linear, weight, fitted[:, None] * linear.residual, scene.point, points)
    by_blob = _rows_of_unknowns(force, adjusted, blob_P[scene.point], blobs)
    middle = add_information((by_blob @ by_blob.T).toarray(), variance**2 * information)
    pose_index, shared_index = local_unknowns(frames)[:, :6].ravel(), np.arange(10 * frames, len(matrix))
    left = inverse[shared_index] @ middle
    poses = _gauge_free_sandwich(inverse[pose_index], middle, pose_index, scene.sfm_T_cam[:, :3, 3])
    return Covariances(poses, left @ inverse[:, shared_index])


def _inverse(matrix: Array) -> Array:
    """The inverse of a positive definite matrix, which is overwritten."""
    triangle = cholesky(matrix, lower=True, overwrite_a=True)
    lower, info = lapack.dpotri(triangle, lower=True, overwrite_c=True)
    if info:
        raise LinAlgError("the reduced camera system is singular")
    return np.tril(lower) + np.tril(lower, -1).T


def _rows_of_unknowns(force_M14: Array, adjusted: Adjusted, blob_M: Ints, blobs: int) -> csr_array:
    """What each blob pulls each unknown by, (10 N + G, blobs)."""
    scene, cameras = adjusted.scene, adjusted.cameras
    frames = len(scene.sfm_T_cam)
    local = block_rows(force_M14[:, :10, None], scene.frame, blob_M, frames, blobs)
    columns = shared_columns(cameras)
    shared = np.zeros((int(columns.max()) + 1, blobs))
    for k in range(columns.shape[1]):
        np.add.at(shared, (columns[scene.frame, k], blob_M), force_M14[:, 10 + k])
    return csr_array(vstack([local.tocsr(), csr_array(shared)]))


def _forces(linear: Linearized, weight_M: Array, residual_M2: Array, point_M: Ints, points: int) -> Array:
    """What each observation (M, 14) pulls its frame's own and shared unknowns by when its point has given way.

    Where an adjustment has converged the points pull nowhere; a few steps before that they do, and what that moves
    would count as the poses' own, the gauge included.
    """
    pull_M2 = weight_M[:, None] * residual_M2
    by_point = linear.by_point
    of_points = summed(np.einsum("mij,mi->mj", by_point, pull_M2), point_M, points)
    curved = (weight_M**2)[:, None, None] * by_point
    blocks = summed(np.einsum("mij,mik->mjk", curved, by_point), point_M, points)
    moved_P3 = np.linalg.solve(blocks, of_points[:, :, None])[:, :, 0]
    by_unknown = np.concatenate([linear.by_frame, linear.by_shared], axis=2)
    return np.einsum("mij,mi->mj", by_unknown, pull_M2 - np.einsum("mij,mj->mi", curved, moved_P3[point_M]))


def _gauge_free_sandwich(inverse_rows: Array, middle: Array, pose_index: Ints, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of inverse @ middle @ inverse where no similarity of all positions is left.

    S-transformation: X -> P X P^T with P = 1 - gauge (positions^T gauge)^-1 positions^T. Only its blocks are needed.
    `inverse_rows` are those of the poses (6 N, n).
    """
    frames = len(position_N3)
    gauge_N67 = similarities(position_N3)
    positions_N67 = gauge_N67.copy()
    positions_N67[:, :3] = 0.0
    gauge, positions = gauge_N67.reshape(-1, 7), positions_N67.reshape(-1, 7)
    h = np.linalg.solve(positions.T @ gauge, positions.T)
    left = inverse_rows @ middle
    blocks = left.reshape(frames, 6, -1) @ np.swapaxes(inverse_rows.reshape(frames, 6, -1), 1, 2)
    of_h = left @ (h @ inverse_rows).T
    gauge_T = np.swapaxes(gauge_N67, 1, 2)
    cross = of_h.reshape(frames, 6, 7) @ gauge_T
    return blocks - cross - np.swapaxes(cross, 1, 2) + gauge_N67 @ (h @ of_h) @ gauge_T
