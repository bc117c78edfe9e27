"""Of a large model: the tracks that are adjusted with its cameras, and the others, triangulated again after that.

Time and memory of an adjustment go by its observations, and a thousand in a frame say little more than some hundred all
over its image. COLMAP's mappers thin tracks out, too.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.geometry.robust import cauchy_weights
from groundwalk.geometry.rows import summed
from groundwalk.sfm.cameras.adjustment import Bundle, Cameras, linearize, loss_of, outer

# An image's parts, along each side, and the tracks that are kept for each; and the points that are kept for a frame at
# least, by whose scatter covariances are known.
_PARTS, _TRACKS_PER_PART, _POINTS_PER_FRAME = 4, 8, 16
_STEPS = 6
_POINTS_AT_ONCE = 20_000


def chosen_tracks(bundle: Bundle, cameras: Cameras) -> NDArray[np.bool_]:
    """Which points (P,) are adjusted: so many for each frame, drawn at random, and more where a sixteenth of an image
    has too few of them."""
    share = bundle.observed_px / (2 * cameras.intrinsics[bundle.frame, 2:])
    column, row = np.clip(_PARTS * share, 0, _PARTS - 1).astype(np.int64).T
    part = (bundle.frame * _PARTS + row) * _PARTS + column
    points, enough = len(bundle.xyz), _POINTS_PER_FRAME * len(bundle.sfm_T_cam)
    order = np.argsort(bundle.point, kind="stable")
    parts_of = np.split(part[order], np.searchsorted(bundle.point[order], np.arange(1, points)))
    kept, count = np.zeros(points, bool), np.zeros(int(part.max(initial=0)) + 1, np.int64)
    for number, point in enumerate(np.random.default_rng(0).permutation(points).tolist()):
        parts = parts_of[point]
        if number < enough or (count[parts] < _TRACKS_PER_PART).any():
            kept[point] = True
            count[parts] += 1
    return kept


def of_points(bundle: Bundle, kept: NDArray[np.bool_]) -> Bundle:
    """The bundle of some points (P,) and all frames."""
    number, own = np.cumsum(kept) - 1, kept[bundle.point]
    held = bundle.held_points
    return replace(
        bundle,
        xyz=bundle.xyz[kept],
        frame=bundle.frame[own],
        point=number[bundle.point[own]],
        observed_px=bundle.observed_px[own],
        held_points=number[held[kept[held]]],
    )


def triangulated(bundle: Bundle, cameras: Cameras, loss_px: float) -> Array:
    """The points (P, 3) by their observations and cameras that stay: Gauss-Newton on a Cauchy loss from where they are,
    of each point the best of some steps. `loss_px` is its width in the end. Held points stay, too."""
    xyz, is_held = bundle.xyz.copy(), np.zeros(len(bundle.xyz), bool)
    is_held[bundle.held_points] = True
    number = np.arange(len(xyz))
    for first in range(0, len(xyz), _POINTS_AT_ONCE):
        chosen = (number >= first) & (number < first + _POINTS_AT_ONCE) & ~is_held
        part = of_points(bundle, chosen)
        points, best = len(part.xyz), part.xyz.copy()
        lowest = np.full(points, np.inf)
        for _ in range(_STEPS):
            linear = linearize(part, cameras)
            square_px2 = np.sum(linear.residual**2, axis=1)
            cost = np.bincount(part.point, np.log1p(square_px2 / loss_px**2), points)
            is_better = cost < lowest
            best[is_better], lowest[is_better] = part.xyz[is_better], cost[is_better]
            weighted = cauchy_weights(linear.residual, loss_of(linear.residual))[:, None, None] * linear.by_point
            blocks = summed(outer(weighted, linear.by_point), part.point, points)
            blocks += 1e-9 * np.trace(blocks, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            pull = summed(np.einsum("mij,mi->mj", weighted, linear.residual), part.point, points)
            part = replace(part, xyz=part.xyz - np.linalg.solve(blocks, pull[:, :, None])[:, :, 0])
        xyz[chosen] = best
    return xyz
