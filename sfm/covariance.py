"""How well the images tie each camera's pose down: covariance of the adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of all positions could take them away, which is what
remains when the model is aligned to something else. Lens, readout, focal lengths and angular velocities are unknowns
with priors, as in the adjustment, and their uncertainty is part of the poses'.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cholesky, lapack
from scipy.sparse import coo_array, csr_array, vstack

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
# Parts of the image in which errors of the cameras' model are alike.
_BANDS, _COLUMNS = 6, 8


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

    What the cameras' model leaves out is alike in a part of the image, or in the rows of a frame that are read out
    together. So residuals are clustered by these, too, and where they hang together more than independent ones would,
    that is added (multiway clustering: Cameron, Gelbach and Miller, J. Business & Economic Statistics 29, 2011).
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
    system = normal_equations(scene, cameras, linear, weight**2)
    matrix = add_information(system.matrix, variance * information)
    hold_gauge(matrix, scene.sfm_T_cam[:, :3, 3])
    try:
        inverse = _inverse(matrix)
    except LinAlgError:
        return None
    fitted = np.sqrt(2 * seen_by / np.maximum(2 * seen_by - 3, 1))[scene.point]
    force = _forces(linear, weight, fitted[:, None] * linear.residual, scene.point, system.point_inverse)
    by_blob = _rows_of_unknowns(force, adjusted, blob_P[scene.point], blobs)
    middle = add_information((by_blob @ by_blob.T).toarray(), variance**2 * information)
    pose_index, shared_index = local_unknowns(frames)[:, :6].ravel(), np.arange(10 * frames, len(matrix))
    left = inverse[shared_index] @ middle
    position = scene.sfm_T_cam[:, :3, 3]
    poses = _gauge_free_sandwich(inverse[pose_index], middle, position)
    poses += _systematic(inverse[pose_index], force, adjusted, position)
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


def _forces(linear: Linearized, weight_M: Array, residual_M2: Array, point_M: Ints, point_inverse: Array) -> Array:
    """What each observation (M, 14) pulls its frame's own and shared unknowns by when its point has given way.

    Where an adjustment has converged the points pull nowhere; a few steps before that they do, and what that moves
    would count as the poses' own, the gauge included.
    """
    pull_M2 = weight_M[:, None] * residual_M2
    by_point = linear.by_point
    of_points = summed(np.einsum("mij,mi->mj", by_point, pull_M2), point_M, len(point_inverse))
    moved_P3 = np.einsum("pij,pj->pi", point_inverse, of_points)
    curved = (weight_M**2)[:, None, None] * by_point
    by_unknown = np.concatenate([linear.by_frame, linear.by_shared], axis=2)
    return np.einsum("mij,mi->mj", by_unknown, pull_M2 - np.einsum("mij,mj->mi", curved, moved_P3[point_M]))


def _systematic(inverse_rows: Array, force_M14: Array, adjusted: Adjusted, position_N3: Array) -> Array:
    """(N, 6, 6) what residuals that hang together in a part of the image, or in some rows of a frame, add to the poses'
    covariance beyond what they would if they were independent; never negative."""
    scene, cameras = adjusted.scene, adjusted.cameras
    frames = len(position_N3)
    centred = (scene.seen_px - cameras.intrinsics[scene.frame, 2:]) / cameras.height[scene.frame, None]
    band = np.clip(np.floor(scene.seen_px[:, 1] / cameras.height[scene.frame] * _BANDS), 0, _BANDS - 1).astype(np.int64)
    column = np.clip(np.floor((centred[:, 0] + 1) / 2 * _COLUMNS), 0, _COLUMNS - 1).astype(np.int64)
    cell = (cameras.lens[scene.frame] * _BANDS + band) * _COLUMNS + column
    rows_of_frame = scene.frame * _BANDS + band
    excess = np.zeros((frames, 6, 6))
    independent = _blocks_of(inverse_rows, _frame_factors(force_M14, adjusted), position_N3)
    for cluster in (cell, rows_of_frame):
        pulls = _rows_of_unknowns(force_M14, adjusted, cluster, int(cluster.max()) + 1)
        more = _blocks_of(inverse_rows, pulls, position_N3) - independent
        value, vector = np.linalg.eigh(more)
        excess += (vector * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(vector, 1, 2)
    return excess


def _frame_factors(force_M14: Array, adjusted: Adjusted) -> csr_array:
    """F (10 N + G, 14 N): F F^T is the sum of what the observations pull by, squared, as if they were independent."""
    scene, cameras = adjusted.scene, adjusted.cameras
    frames, width = len(scene.sfm_T_cam), force_M14.shape[1]
    factors = np.zeros((frames, width, width))
    bounds = np.searchsorted(scene.frame, np.arange(frames + 1))
    for k in range(frames):
        own = force_M14[bounds[k] : bounds[k + 1]]
        triangle = np.asarray(np.linalg.qr(own, mode="r"), float)
        factors[k, :, : len(triangle)] = triangle.T
    unknown = np.concatenate([local_unknowns(frames), 10 * frames + shared_columns(cameras)], axis=1)
    column = width * np.arange(frames)[:, None] + np.arange(width)
    rows = np.broadcast_to(unknown[:, :, None], factors.shape)
    columns = np.broadcast_to(column[:, None, :], factors.shape)
    size = (int(unknown.max()) + 1, width * frames)
    return csr_array(coo_array((factors.ravel(), (rows.ravel(), columns.ravel())), shape=size))


def _blocks_of(inverse_rows: Array, factor: csr_array, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of inverse @ F F^T @ inverse where no similarity of all positions is left."""
    gauge, h = _gauge_of(position_N3)
    spread = np.ascontiguousarray((factor.T @ inverse_rows.T).T)
    spread -= gauge @ (h @ spread)
    blocks = spread.reshape(len(position_N3), 6, -1)
    return blocks @ np.swapaxes(blocks, 1, 2)


def _gauge_of(position_N3: Array) -> tuple[Array, Array]:
    """What similarities do to all poses (6 N, 7), and (7, 6 N) which similarity the positions say."""
    gauge_N67 = similarities(position_N3)
    positions_N67 = gauge_N67.copy()
    positions_N67[:, :3] = 0.0
    gauge, positions = gauge_N67.reshape(-1, 7), positions_N67.reshape(-1, 7)
    return gauge, np.asarray(np.linalg.solve(positions.T @ gauge, positions.T), float)


def _gauge_free_sandwich(inverse_rows: Array, middle: Array, position_N3: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of inverse @ middle @ inverse where no similarity of all positions is left.

    S-transformation: X -> P X P^T with P = 1 - gauge (positions^T gauge)^-1 positions^T. Only its blocks are needed.
    `inverse_rows` are those of the poses (6 N, n).
    """
    frames = len(position_N3)
    gauge, h = _gauge_of(position_N3)
    gauge_N67 = gauge.reshape(frames, 6, 7)
    left = inverse_rows @ middle
    blocks = left.reshape(frames, 6, -1) @ np.swapaxes(inverse_rows.reshape(frames, 6, -1), 1, 2)
    of_h = left @ (h @ inverse_rows).T
    gauge_T = np.swapaxes(gauge_N67, 1, 2)
    cross = of_h.reshape(frames, 6, 7) @ gauge_T
    return blocks - cross - np.swapaxes(cross, 1, 2) + gauge_N67 @ (h @ of_h) @ gauge_T
