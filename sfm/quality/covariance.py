"""How well the images tie each camera's pose down: covariance of the adjustment, free of any one camera's gauge.

COLMAP's own covariance holds two cameras fixed, so theirs is missing and everyone else's is relative to them. Here the
gauge is the model's own: errors count as far as no similarity of all positions could take them away, which is what
remains when the model is aligned to something else. Lens, readout, focal lengths and angular velocities are unknowns
with priors, as in the adjustment, and their uncertainty is part of the poses'.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError
from scipy.sparse import coo_array, csr_array, vstack
from scipy.sparse.csgraph import connected_components

from groundwalk.geometry.poses import Array
from groundwalk.geometry.robust import cauchy_weights
from groundwalk.geometry.rows import summed
from groundwalk.geometry.shutter import readout_fraction, sensor_axes
from groundwalk.sfm.cameras.adjustment import (
    CENTRE,
    Adjusted,
    Bundle,
    Ints,
    Linearization,
    is_large,
    linearize,
    local_unknowns,
    loss_variance,
    prior_draw,
    prior_information,
    regular_system,
    shared_columns,
)
from groundwalk.sfm.cameras.normal_equations import IterativeSolver, System, block_rows, inverse_of, similarities
from groundwalk.store.progress import track

# Features of one keypoint have its place to the bit; a hundredth allows for rounding.
_SAME_PLACE_PX = 0.01
# The scatter of keypoints tells that of the poses where there are some more of them than unknowns.
_KEYPOINTS_PER_UNKNOWN = 2
# By how much variances of poses grow, as neighbouring features share errors: without it the normalised
# squared error is 1.2 by charuco's board and 1.2 to 2.1 in simulated captures (docs/explanation/decisions.md).
SHARED_ERRORS = 1.7
# Parts of the image in which errors of the cameras' model are alike.
_BANDS, _COLUMNS = 6, 8
_CHUNK = 16  # frames at once, for memory
# Samples of large models' errors, by which their standard deviations are known to 9 %, and those at once, for memory.
_SAMPLES, _AT_ONCE = 60, 30


@dataclass(frozen=True)
class Covariances:
    """Of an adjusted model's frames (N, 6, 6), in the order rotation (rad, 3), position (sfm units, 3): true rotation =
    exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position, both along the sfm axes, the rotation
    that of the pixels' rays, which a principal point that is off leaves as they are; and of what the frames share
    (G, G): the unknowns of each lens, then each session's log focal factor; and the coherence of residuals in rows of a
    frame and in regions of the image, by which they have grown."""

    poses: Array
    shared: Array
    by_rows: float
    by_region: float


def covariances(adjusted: Adjusted) -> Covariances | None:
    """None where there are too few points to tell.

    Nothing is assumed of the noise but that errors of two keypoints have nothing to do with each other: those of one in
    the frames that see it are correlated, as its features slide with the view, and points of one keypoint share them.
    So this is the sandwich of an M-estimator, clustered by keypoint (Huber 1967; Liang and Zeger, Biometrika 73, 1986;
    a point's residuals are scaled up for the three numbers that were fitted to them), brought to the gauge of all
    positions by an S-transformation (Baarda 1973).

    What the cameras' model leaves out is alike in the rows of a frame that are read out together, or in a region of the
    image. Where residuals are correlated more than independent ones would be (`coherence`), covariances grow by it, and
    those of poses by what even a right model leaves (`SHARED_ERRORS`).

    Where frames and points are held, what comes out is how certain the others are if these are right.
    Of large models poses' covariances are those of a sample of errors (`_sampled_covariances`).
    """
    bundle, cameras = adjusted.bundle, adjusted.cameras
    frames, points = len(bundle.sfm_T_cam), len(bundle.xyz)
    track_length = np.bincount(bundle.point, minlength=points)
    keypoint_P = keypoints_of(bundle)
    keypoints = int(keypoint_P.max(initial=-1)) + 1
    is_held = np.zeros(points, bool)
    is_held[bundle.held_points] = True
    free_frames = frames - len(bundle.held_frames)
    if keypoints < _KEYPOINTS_PER_UNKNOWN * 6 * free_frames or track_length[~is_held].min(initial=2) < 2:
        return None
    linear = linearize(bundle, cameras).over(adjusted.noise_M)
    weight = cauchy_weights(linear.residual, adjusted.loss_px)
    variance = loss_variance(adjusted.loss_px)
    information = prior_information(cameras, adjusted.priors)
    # The mean curvature of Cauchy's loss at a residual is its weight squared.
    system = regular_system(bundle, cameras, linear, weight**2, variance * information)
    fitted = np.sqrt(2 * track_length / np.where(is_held, 2 * track_length, np.maximum(2 * track_length - 3, 1)))
    fitted = fitted[bundle.point]
    force = _forces(linear, weight, fitted[:, None] * linear.residual, bundle.point, system.point_inverse)
    by_rows, by_region = coherence(adjusted, linear.residual, keypoint_P)
    del linear  # for memory, as below
    by_keypoint = _rows_of_unknowns(force, adjusted, keypoint_P[bundle.point], keypoints)
    del force
    free, is_free = system.free, ~np.isin(np.arange(frames), bundle.held_frames)
    by_keypoint, information = by_keypoint[free], information[free][:, free]
    gauge, h = _gauge_of(bundle.sfm_T_cam[is_free, :3, 3])
    if len(bundle.held_points):
        gauge, h = np.zeros_like(gauge), np.zeros_like(h)
    poses, rays = np.zeros((frames, 6, 6)), _moves_of_rays(adjusted)[np.repeat(is_free, 6)][:, free]
    try:
        if is_large(free_frames):
            of_shared, poses[is_free] = _sampled_covariances(
                adjusted, system, by_keypoint, variance * information, rays, gauge, h
            )
        else:
            inverse = inverse_of(system.of_free.matrix())
            of_shared = inverse[10 * free_frames :]
            poses[is_free] = _gauge_free_sandwich(inverse, by_keypoint, variance**2 * information, rays, gauge, h)
    except LinAlgError:
        return None
    # The part of the keypoints grows with what they have in common, that of the priors doesn't.
    by_keypoints = of_shared @ by_keypoint
    shared = max(by_rows, by_region) * by_keypoints @ by_keypoints.T
    shared += variance**2 * of_shared @ (information @ of_shared.T)
    return Covariances(SHARED_ERRORS * by_rows * poses, shared, by_rows, by_region)


def _sampled_covariances(
    adjusted: Adjusted,
    system: System,
    by_keypoint: csr_array,
    information: csr_array,
    rays: csr_array,
    gauge: Array,
    h: Array,
) -> tuple[Array, Array]:
    """Rows of the free unknowns' inverse (G, F) of those that frames share, and the N free frames' covariances
    (N, 6, 6) as those of a sample of errors: keypoints and priors pull with random signs and sizes, and the poses give
    way."""
    rng, free, of_free = np.random.default_rng(0), system.free, system.of_free
    solver = IterativeSolver(of_free, of_free.diagonal(), 0.0)
    parts = []
    of_shared = solver.inverse_times(np.eye(len(free), len(free) - of_free.size, -of_free.size))
    for _ in track(range(_SAMPLES // _AT_ONCE), "sampling uncertainties"):
        drawn = np.array([prior_draw(adjusted.cameras, adjusted.priors, rng)[free] for _ in range(_AT_ONCE)])
        pulls = by_keypoint @ rng.standard_normal((by_keypoint.shape[1], _AT_ONCE)) + information @ drawn.T
        parts.append(rays @ solver.inverse_times(pulls))
    moved = np.hstack(parts)
    moved = (moved - gauge @ (h @ moved)).reshape(-1, 6, _SAMPLES)
    # So few samples may have missed where errors are large: so much larger, squared errors over them are as expected
    # (the mean of an inverse Wishart distribution).
    return of_shared.T, moved @ np.swapaxes(moved, 1, 2) / (_SAMPLES - 6 - 1)


def keypoints_of(bundle: Bundle) -> Ints:
    """The number of each point's keypoint, (P,): SIFT gives a keypoint a feature for each of its orientations, so
    points that any frame sees in the same place are of one."""
    place = np.round(bundle.observed_px / _SAME_PLACE_PX).astype(np.int64)
    _, keypoint = np.unique(np.column_stack([bundle.frame, place]), axis=0, return_inverse=True)
    points = len(bundle.xyz)
    size = points + int(keypoint.max(initial=-1)) + 1
    ties = coo_array((np.ones(len(bundle.point), bool), (bundle.point, points + keypoint.ravel())), shape=(size, size))
    label = connected_components(ties, directed=False)[1][:points]
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64).ravel()


def _forces(linear: Linearization, weight_M: Array, residual_M2: Array, point_M: Ints, point_inverse: Array) -> Array:
    """What each observation (M, 17) pulls the unknowns of its camera by when its point has given way.

    Where an adjustment has converged the points pull nowhere; a few steps before that they do, and what that moves
    would count as theirs, the gauge included.
    """
    pull_M2 = weight_M[:, None] * residual_M2
    of_points = summed(np.einsum("mij,mi->mj", linear.by_point, pull_M2), point_M, len(point_inverse))
    moved_P3 = np.einsum("pij,pj->pi", point_inverse, of_points)
    curved = (weight_M**2)[:, None, None] * linear.by_point
    return np.einsum("mij,mi->mj", linear.by_camera, pull_M2 - np.einsum("mij,mj->mi", curved, moved_P3[point_M]))


def _rows_of_unknowns(force_M17: Array, adjusted: Adjusted, keypoint_M: Ints, keypoints: int) -> csr_array:
    """What each keypoint pulls each unknown by, (10 N + G, keypoints)."""
    bundle, columns = adjusted.bundle, shared_columns(adjusted.cameras)
    local = block_rows(force_M17[:, :10, None], bundle.frame, keypoint_M, len(bundle.sfm_T_cam), keypoints)
    shared = np.zeros((int(columns.max()) + 1, keypoints))
    for k in range(columns.shape[1]):
        np.add.at(shared, (columns[bundle.frame, k], keypoint_M), force_M17[:, 10 + k])
    return csr_array(vstack([local.tocsr(), csr_array(shared)]))


def coherence(adjusted: Adjusted, residual_M2: Array, keypoint_P: Ints) -> tuple[float, float]:
    """How much more residuals (in units of their points' noise) are correlated in the rows of a frame that are read out
    together, and in a region of the image over all frames, than independent ones would be: the ratio of the variances
    of their sums (Kish's design effect), at least 1, less what may be chance. A shutter or focus that isn't modelled
    shows in the first, a lens in the second.
    """
    bundle, cameras = adjusted.bundle, adjusted.cameras
    residual = residual_M2 / (1 + np.sum(residual_M2**2, axis=1, keepdims=True) / adjusted.loss_px**2)
    # Features of one keypoint are in the same place with the same error.
    key = bundle.frame * (int(keypoint_P.max(initial=0)) + 1) + keypoint_P[bundle.point]
    _, first = np.unique(key, return_index=True)
    residual, frame, observed_px = residual[first], bundle.frame[first], bundle.observed_px[first]
    line = cameras.readout_line[frame]
    band = np.clip((readout_fraction(line, observed_px) + 0.5) * _BANDS, 0, _BANDS - 1).astype(np.int64)
    offset_px = observed_px - cameras.centre[frame]
    across = line[:, 1] * offset_px[:, 0] - line[:, 0] * offset_px[:, 1]
    column = np.clip((across + 1) / 2 * _COLUMNS, 0, _COLUMNS - 1)
    region = (cameras.lens[frame] * _BANDS + band) * _COLUMNS + column.astype(np.int64)
    return _design_effect(residual, frame * _BANDS + band), _design_effect(residual, region)


def _design_effect(residual_M2: Array, cluster_M: Ints) -> float:
    _, cluster = np.unique(cluster_M, return_inverse=True)
    clusters = int(cluster.max()) + 1
    ratio = float(np.sum(summed(residual_M2, cluster, clusters) ** 2) / max(np.sum(residual_M2**2), 1e-12))
    return max(1.0, ratio / (1 + 2 / np.sqrt(clusters)))


def _gauge_of(position_N3: Array) -> tuple[Array, Array]:
    """What similarities do to all poses (6 N, 7), and (7, 6 N) which similarity the positions say."""
    gauge_N67 = similarities(position_N3)
    positions_N67 = gauge_N67.copy()
    positions_N67[:, :3] = 0.0
    gauge, positions = gauge_N67.reshape(-1, 7), positions_N67.reshape(-1, 7)
    return gauge, np.asarray(np.linalg.solve(positions.T @ gauge, positions.T), float)


def _moves_of_rays(adjusted: Adjusted) -> csr_array:
    """(6 N, 10 N + G) how each unknown turns and shifts the rays of a frame's pixels: its pose does, and its principal
    point, which turns them and, to first order, no more."""
    cameras, sfm_T_cam = adjusted.cameras, adjusted.bundle.sfm_T_cam
    frames, columns = len(sfm_T_cam), shared_columns(cameras)
    # Of pixels to the right of the principal point that moves there, and below one that moves down.
    by_px = np.stack([-sfm_T_cam[:, :3, 1], sfm_T_cam[:, :3, 0]], axis=2) / cameras.focal[:, None]
    turn = by_px @ np.swapaxes(sensor_axes(cameras.readout_line), 1, 2)
    row = np.broadcast_to((6 * np.arange(frames)[:, None] + np.arange(3))[:, :, None], turn.shape)
    centre = np.broadcast_to((10 * frames + columns[:, CENTRE])[:, None, :], turn.shape)
    rows = np.concatenate([np.arange(6 * frames), row.ravel()])
    unknowns = np.concatenate([local_unknowns(frames)[:, :6].ravel(), centre.ravel()])
    values = np.concatenate([np.ones(6 * frames), turn.ravel()])
    shape = (6 * frames, 10 * frames + int(columns.max()) + 1)
    return csr_array(coo_array((values, (rows, unknowns)), shape=shape))


def _gauge_free_sandwich(
    inverse: Array, by_keypoint: csr_array, information: csr_array, rays: csr_array, gauge: Array, h: Array
) -> Array:
    """The (N, 6, 6) diagonal blocks of X (by_keypoint @ by_keypoint^T + information) X^T, X = rays @ inverse, where no
    similarity of all positions is left.

    S-transformation: X -> P X P^T with P = 1 - gauge h, h = (positions^T gauge)^-1 positions^T, both 0 where something
    else holds the gauge. Only its blocks are needed, and the middle isn't formed, as it is hardly sparse.
    """
    keypoint_rows = by_keypoint.T.tocsr()
    of_gauge, blocks = (h @ rays) @ inverse, [np.empty((0, 6, 6))]
    for first in range(0, len(gauge), 6 * _CHUNK):
        chunk = slice(first, first + 6 * _CHUNK)
        rows = rays[chunk] @ inverse - gauge[chunk] @ of_gauge
        by_keypoints = np.ascontiguousarray((keypoint_rows @ rows.T).T)
        blocks.append(_blocks(by_keypoints, by_keypoints) + _blocks(rows @ information, rows))
    return np.concatenate(blocks)


def _blocks(a: Array, b: Array) -> Array:
    """The (N, 6, 6) diagonal blocks of a @ b^T, of 6 N rows each."""
    return a.reshape(-1, 6, a.shape[1]) @ np.swapaxes(b.reshape(-1, 6, b.shape[1]), 1, 2)
