"""Depth images: sampled where a camera saw points, and compared with other depths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array

# Where the pixels around differ by a larger fraction, an edge is near and interpolation would mix two surfaces.
_EDGE_FRACTION = 0.05
_RESAMPLINGS = 200


@dataclass(frozen=True)
class RatioStatistics:
    """Median of ratios, median absolute deviation from it, and the median's standard error (NaN for one cluster)."""

    median: float
    mad: float
    se: float


def smooth_pixels(depth: Array) -> NDArray[np.bool_]:
    """Which pixels (H, W) of a depth image (0: no depth) have depth all around and no edge: their 3x3 neighbours lie
    within 5 % of each other."""
    low, high = minimum_filter(depth, 3, mode="nearest"), maximum_filter(depth, 3, mode="nearest")
    smooth: NDArray[np.bool_] = (low > 0) & (high - low <= _EDGE_FRACTION * low)
    return smooth


def sample_depth(depth: Array, xy_px: Array, size: tuple[int, int]) -> tuple[Array, NDArray[np.int64]]:
    """Depth at places (N, 2) of the image that a depth image (H, W) shows, interpolated between its four pixels; NaN
    near an edge, where there is none, or outside. Also the (row, column) of the nearest pixel (N, 2).

    `xy_px` are pixels of the image of `size` (width, height), with (0, 0) the first pixel's outer corner, in both.
    """
    height, width = depth.shape
    at = np.asarray(xy_px, dtype=float).reshape(-1, 2) * [width / size[0], height / size[1]]
    inside = ((at >= 0) & (at < [width, height])).all(axis=1)
    nearest = np.clip(np.floor(np.nan_to_num(at)), 0, [width - 1, height - 1]).astype(np.int64)[:, ::-1]
    is_smooth = inside & smooth_pixels(depth)[nearest[:, 0], nearest[:, 1]]
    sampled: Array = map_coordinates(np.asarray(depth, dtype=float), at.T[::-1] - 0.5, order=1, mode="nearest")
    return np.where(is_smooth, sampled, np.nan), nearest


def ratio_statistics(ratio: Array, cluster: NDArray[np.int64], rng: np.random.Generator) -> RatioStatistics:
    """Statistics of ratios (N,) whose errors are alike within a cluster (N,): the standard error is by drawing whole
    clusters with replacement (Field and Welsh, "Bootstrapping clustered data", JRSS B 69, 2007).

    Raises GeometryError for no ratios.
    """
    if not len(ratio):
        raise GeometryError("no ratios, so no median of them")
    median = float(np.median(ratio))
    members = [ratio[cluster == c] for c in np.unique(cluster)]
    se = float("nan")
    if len(members) > 1:
        draws = rng.integers(0, len(members), (_RESAMPLINGS, len(members)))
        se = float(np.std([np.median(np.concatenate([members[i] for i in draw])) for draw in draws]))
    return RatioStatistics(median, float(np.median(np.abs(ratio - median))), se)
