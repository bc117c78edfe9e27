"""Which pairs of frames are worth matching: pure functions on arrays.

Frames are rows 0..N-1. Pairs are (P, 2) integer arrays of rows, first < second, without duplicates, sorted. Each
proposal is capped per frame, so that the number of pairs grows linearly with the number of frames.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from groundwalk.geometry.poses import Array
from groundwalk.store.choices import PairOrigin

Pairs = NDArray[np.int64]

# Depths at which a view's frustum is sampled, as fractions of the distance beyond which two views share nothing.
_DEPTH_FRACTIONS = (0.25, 0.5, 1.0)
_SAMPLES_PER_AXIS = 5
_PAIRS_AT_ONCE = 20_000


def unique_pairs(pairs: ArrayLike) -> Pairs:
    """Pairs (P, 2) in any order, with duplicates, as sorted distinct pairs with first < second."""
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    ordered = np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1)
    return np.unique(ordered, axis=0)


def sequence_pairs(recording_N: ArrayLike, t_ns_N: ArrayLike, steps: Sequence[int]) -> Pairs:
    """Each frame with those that are so many `steps` later in its recording, by time."""
    recording_N, t_ns_N = np.asarray(recording_N), np.asarray(t_ns_N)
    proposed = [np.empty((0, 2), np.int64)]
    for recording in np.unique(recording_N):
        rows = np.flatnonzero(recording_N == recording)
        rows = rows[np.argsort(t_ns_N[rows], kind="stable")]
        proposed += [np.stack([rows[:-step], rows[step:]], axis=1) for step in steps if step < len(rows)]
    return unique_pairs(np.concatenate(proposed))


def broken_links(recording_N: ArrayLike, t_ns_N: ArrayLike, linked: Pairs) -> Pairs:
    """Pairs of neighbours in a recording, by time, that aren't among the linked pairs."""
    count = len(np.asarray(recording_N))
    links = sequence_pairs(recording_N, t_ns_N, [1])
    return links[~np.isin(_key(links, count), _key(linked, count))]


def within_vio_limits(
    pairs: Pairs, session_N: ArrayLike, vio_T_cam: Array, max_distance_m: ArrayLike, max_angle_deg: ArrayLike
) -> NDArray[np.bool_]:
    """Whether the two frames of each pair can see the same thing as far as VIO knows, (P,).

    Frames of one session farther apart than `max_distance_m`, or with viewing directions that differ by more than
    `max_angle_deg`, can't; both may be one number or one a pair. VIO knows nothing of frames of two sessions, nor of a
    frame without a pose (NaN).
    """
    session_N = np.asarray(session_N)
    a, b = pairs.T
    distance = np.linalg.norm(vio_T_cam[a, :3, 3] - vio_T_cam[b, :3, 3], axis=1)
    cosine = np.sum(vio_T_cam[a, :3, 2] * vio_T_cam[b, :3, 2], axis=1)
    min_cosine = np.cos(np.radians(np.minimum(max_angle_deg, 180.0)))
    apart = (distance > np.asarray(max_distance_m)) | (cosine < min_cosine)
    return (session_N[a] != session_N[b]) | ~apart


def vio_pairs(
    session_N: ArrayLike,
    vio_T_cam: Array,
    intrinsics_N4: Array,
    size_N2: Array,
    max_distance_m: float,
    max_angle_deg: float,
    per_frame: int,
) -> Pairs:
    """For each frame the `per_frame` frames of its session, within the limits, that its view overlaps with most.

    `vio_T_cam` (N, 4, 4) in metres, `intrinsics_N4` fx, fy, cx, cy and `size_N2` width, height in pixels.
    """
    session_N = np.asarray(session_N)
    proposed = [np.empty((0, 2), np.int64)]
    for session in np.unique(session_N):
        rows = np.flatnonzero((session_N == session) & np.isfinite(vio_T_cam).all(axis=(1, 2)))
        if len(rows) > 1:
            near = cKDTree(vio_T_cam[rows, :3, 3]).query_pairs(max_distance_m, output_type="ndarray")
            proposed.append(rows[near])
    pairs = unique_pairs(np.concatenate(proposed))
    pairs = pairs[within_vio_limits(pairs, session_N, vio_T_cam, max_distance_m, max_angle_deg)]
    overlap = view_overlap(pairs, vio_T_cam, intrinsics_N4, size_N2, max_distance_m)
    return strongest_pairs(pairs[overlap > 0], overlap[overlap > 0], per_frame)


def view_overlap(pairs: Pairs, world_T_cam: Array, intrinsics_N4: Array, size_N2: Array, reach_m: float) -> Array:
    """The fraction of the two views of each pair that the other one sees too, (P,).

    Views reach up to `reach_m`: points on rays of one view at several depths up to there are projected into the
    other; the fraction is the smaller of the two directions.
    """
    grid = (np.arange(_SAMPLES_PER_AXIS) + 0.5) / _SAMPLES_PER_AXIS
    u, v = np.meshgrid(grid, grid)
    position_S2 = np.stack([u.ravel(), v.ravel()], axis=1)
    rays_NS2 = (position_S2 * size_N2[:, None] - intrinsics_N4[:, None, 2:]) / intrinsics_N4[:, None, :2]
    rays_NS3 = np.concatenate([rays_NS2, np.ones((*rays_NS2.shape[:2], 1))], axis=2)
    depths = reach_m * np.array(_DEPTH_FRACTIONS)
    points_NS3 = (rays_NS3[:, None] * depths[:, None, None]).reshape(len(rays_NS3), -1, 3)

    def visible_fraction(a: Pairs, b: Pairs) -> Array:
        b_R_a = np.swapaxes(world_T_cam[b, :3, :3], 1, 2) @ world_T_cam[a, :3, :3]
        a_in_b = np.einsum("pji,pj->pi", world_T_cam[b, :3, :3], world_T_cam[a, :3, 3] - world_T_cam[b, :3, 3])
        xyz = np.einsum("pij,psj->psi", b_R_a, points_NS3[a]) + a_in_b[:, None]
        ahead = xyz[..., 2] > 1e-6
        pixel = xyz[..., :2] / np.where(ahead, xyz[..., 2], 1.0)[..., None] * intrinsics_N4[b, None, :2]
        pixel = pixel + intrinsics_N4[b, None, 2:]
        inside = ((pixel >= 0) & (pixel <= size_N2[b, None])).all(axis=2)
        return np.mean(ahead & inside, axis=1)

    chunks = np.array_split(pairs, max(1, -(-len(pairs) // _PAIRS_AT_ONCE)))
    return np.concatenate(
        [np.minimum(visible_fraction(*chunk.T), visible_fraction(*chunk.T[::-1])) for chunk in chunks]
    )


def strongest_pairs(pairs: Pairs, score_P: ArrayLike, per_frame: int) -> Pairs:
    """The pairs that are among the `per_frame` best of either of their frames; at most `per_frame` times N."""
    both = pd.DataFrame({"frame": pairs.T.ravel(), "score": np.tile(score_P, 2)}, np.tile(np.arange(len(pairs)), 2))
    best = both.sort_values("score", ascending=False, kind="stable").groupby("frame").head(per_frame)
    return pairs[np.unique(best.index)]


def transitive_pairs(pairs: Pairs, inliers_P: ArrayLike, frames: int) -> tuple[Pairs, Array]:
    """Untried pairs whose frames both match a third one, and how strong their tie is.

    `pairs` are all that were tried, `inliers_P` their verified inliers (0: not verified). A chain's strength is the
    geometric mean of its two links' inliers; the strengths of all chains between two frames add up.
    """
    a, b = pairs.T
    links = csr_array((np.sqrt(np.asarray(inliers_P, dtype=float)), (a, b)), shape=(frames, frames))
    links = links + links.T
    chains = (links @ links).tocoo()
    upper = chains.row < chains.col
    candidates = np.stack([chains.row[upper], chains.col[upper]], axis=1).astype(np.int64)
    strength = chains.data[upper]
    new = (strength > 0) & ~np.isin(_key(candidates, frames), _key(pairs, frames))
    order = np.argsort(_key(candidates[new], frames))
    return candidates[new][order], strength[new][order]


def first_origins(proposals: Sequence[tuple[PairOrigin, Pairs]], frames: int) -> tuple[Pairs, NDArray[np.str_]]:
    """All proposed pairs, and for each the origin of the first proposal that has it."""
    every = np.concatenate([pairs for _, pairs in proposals])
    origin = np.concatenate([np.full(len(pairs), origin) for origin, pairs in proposals])
    _, first = np.unique(_key(every, frames), return_index=True)
    return every[first], origin[first]


def _key(pairs: Pairs, frames: int) -> NDArray[np.int64]:
    return pairs[:, 0] * frames + pairs[:, 1]
