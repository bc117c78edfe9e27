"""Tracks of features over frames with known poses, and their points: pure functions on arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import summed

Ints = NDArray[np.int64]
_ROUNDS = 8


@dataclass(frozen=True)
class Rays:
    """R features of frames as rays in the map: where each was seen from (R, 3), its direction (R, 3) of unit depth, the
    frame's focal length (R,), px, and its frame (R,)."""

    origin: Array
    direction: Array
    focal_px: Array
    view: Ints

    def __getitem__(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Rays":
        return Rays(self.origin[rows], self.direction[rows], self.focal_px[rows], self.view[rows])


@dataclass(frozen=True)
class Points:
    """P points xyz (P, 3) in the map with their information (P, 3, 3), 1/m^2 for observations of one pixel, and O
    observations of them: point (O,) and feature (O,), sorted by point, with their residual (O,), px."""

    xyz: Array
    information: Array
    point: Ints
    feature: Ints
    residual_px: Array


def epipolar_error_px(a: Rays, b: Rays) -> Array:
    """How far M pairs of rays pass by each other, (M,): px in the image in which that is smaller.

    Infinite where rays meet behind one of the two.
    """
    u, v, baseline = a.direction, b.direction, b.origin - a.origin
    normal = np.cross(u, v)
    length = np.linalg.norm(normal, axis=1)
    products = (u, u), (v, v), (u, v), (u, baseline), (v, baseline)
    aa, bb, ab, da, db = (np.sum(x * y, axis=1) for x, y in products)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_a = (da * bb - db * ab) / (aa * bb - ab * ab)
        depth_b = (da * ab - db * aa) / (aa * bb - ab * ab)
        gap = np.abs(np.sum(baseline * normal, axis=1)) / length
        error = gap * np.minimum(a.focal_px / depth_a, b.focal_px / depth_b)
    return np.where((depth_a > 0) & (depth_b > 0), error, np.inf)


def tracks(matches_M2: Ints, view: Ints) -> tuple[Ints, Ints]:
    """Connected components of matched features as (track (O,), feature (O,)), sorted by track; of two frames at
    least."""
    count = len(view)
    graph = coo_array((np.ones(len(matches_M2), np.int8), (matches_M2[:, 0], matches_M2[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    feature = np.flatnonzero(np.bincount(label)[label] > 1)
    feature = feature[np.argsort(label[feature], kind="stable")]
    return np.unique(label[feature], return_inverse=True)[1].astype(np.int64), feature


def triangulate(rays: Rays, point: Ints, feature: Ints, max_px: float, min_angle_deg: float) -> Points:
    """Points of tracks (point (O,) from 0, feature (O,)), each the one from which its rays pass least far, robustly.

    Observations beyond `max_px` are left out one a point and round, the worst first; of two of one frame the worse.
    Points of fewer than two frames, or whose rays meet at less than `min_angle_deg`, are dropped.
    """
    for _ in range(_ROUNDS):
        seen = rays[feature]
        xyz, information, residual = _adjusted(seen, point, max_px)
        worst = _worst(point, residual, residual > max_px) | _worse_of_frame(point, seen.view, residual)
        if not worst.any():
            break
        point, feature = point[~worst], feature[~worst]
        two = np.bincount(point)[point] > 1
        point, feature = np.unique(point[two], return_inverse=True)[1].astype(np.int64), feature[two]
    xyz, information, residual = _adjusted(rays[feature], point, max_px)
    bad = np.zeros(int(point.max(initial=-1)) + 1, bool)
    bad[point[~(residual <= max_px)]] = True
    bad |= _widest_angle(rays[feature], point, xyz) < np.radians(min_angle_deg)
    kept = ~bad[point]
    number = np.cumsum(~bad) - 1
    return Points(xyz[~bad], information[~bad], number[point[kept]], feature[kept], residual[kept])


def _adjusted(seen: Rays, point: Ints, max_px: float) -> tuple[Array, Array, Array]:
    """Points (P, 3), their information (P, 3, 3) and residuals (O,), px, by Gauss-Newton with Cauchy weights."""
    count = int(point.max(initial=-1)) + 1
    unit = seen.direction / np.linalg.norm(seen.direction, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    # Linear start: nearest to all rays; then weights by depth and residual, so that what is least is pixels.
    weight = np.ones(len(point))
    xyz, residual = np.zeros((count, 3)), np.zeros(len(point))
    information = np.zeros((count, 3, 3))
    for _ in range(10):
        weighted = across * weight[:, None, None]
        information = summed(weighted, point, count)
        right = summed(np.einsum("oij,oj->oi", weighted, seen.origin), point, count)
        ridge = 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-30 * np.eye(3)
        xyz = np.linalg.solve(information + ridge, right[:, :, None])[:, :, 0]
        offset = xyz[point] - seen.origin
        depth = np.sum(offset * unit, axis=1)
        miss = np.linalg.norm(offset - depth[:, None] * unit, axis=1)
        residual = np.where(depth > 0, seen.focal_px * miss / np.maximum(depth, 1e-9), np.inf)
        weight = (seen.focal_px / np.maximum(np.abs(depth), 0.05)) ** 2 / (1 + np.minimum(residual / max_px, 1e3) ** 2)
    return xyz, information, residual


def _worst(point: Ints, residual: Array, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of each point the observation with the largest residual, where it's `among`."""
    order = np.lexsort((residual, point))
    last = np.flatnonzero(np.diff(point[order], append=-1))
    worst = np.zeros(len(point), bool)
    worst[order[last]] = True
    return worst & among


def _worse_of_frame(point: Ints, view: Ints, residual: Array) -> NDArray[np.bool_]:
    """Observations of a point in a frame that has a better one."""
    order = np.lexsort((residual, view, point))
    again = (point[order][1:] == point[order][:-1]) & (view[order][1:] == view[order][:-1])
    worse = np.zeros(len(point), bool)
    worse[order[1:][again]] = True
    return worse


def _widest_angle(seen: Rays, point: Ints, xyz: Array) -> Array:
    """About the widest angle (P,) between the rays of a point: twice the widest one to their mean, rad."""
    direction = seen.origin - xyz[point]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    mean = summed(direction, point, len(xyz))
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    off = np.linalg.norm(direction - mean[point], axis=1)
    widest = np.zeros(len(xyz))
    np.maximum.at(widest, point, off)
    return 2 * widest
