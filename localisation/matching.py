"""Matching of descriptors, and which frames with known poses are worth it: pure functions on arrays."""

import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.geometry.poses import Array
from groundwalk.localisation.localisers import SIFT

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
_DEPTHS = 3
_SAMPLES = 5


def unit(descriptors: NDArray[np.generic]) -> NDArray[np.float32]:
    """Descriptors (..., D) at unit length."""
    floats = np.asarray(descriptors, np.float32)
    return np.asarray(floats / np.maximum(np.linalg.norm(floats, axis=-1, keepdims=True), 1e-9), np.float32)


def mutual_matches(a: Floats, b: Floats, ratio: float) -> Ints:
    """Rows (M, 2) of unit descriptors (A, D) and (B, D) that are each other's nearest, at a distance below `ratio` of
    those to either one's second nearest (Lowe, IJCV 2004)."""
    if len(a) < 2 or len(b) < 2:
        return np.empty((0, 2), np.int64)
    product = a @ b.T
    nearest = product.argmax(axis=1)
    best = product[np.arange(len(a)), nearest]
    i = np.flatnonzero(best == product.max(axis=0)[nearest])
    j = nearest[i]
    product[i, j] = -1.0
    second = np.maximum(product.max(axis=1)[i], product.max(axis=0)[j])
    # Squared distances of unit vectors are twice one minus their product.
    kept = 1 - best[i] < ratio**2 * (1 - second)
    return np.stack([i[kept], j[kept]], axis=1)


def match_sift(a: Features, b: Features, a_size: object, b_size: object) -> Ints:
    """Mutual matches (M, 2) of SIFT features whose descriptors are of unit length; of images of any size."""
    return mutual_matches(a.descriptors, b.descriptors, SIFT.ratio)


def covisible_pairs(map_T_cam: Array, extent_N2: Array, reach_m: float, per_frame: int) -> Ints:
    """Pairs (P, 2) of frames, first < second, that are among the `per_frame` frames with which either shares most of
    its view up to `reach_m`; `extent_N2` is half the image's width and height at unit focal length."""
    side, depths = np.linspace(-0.8, 0.8, _SAMPLES), reach_m * 0.5 ** np.arange(_DEPTHS)
    share = np.zeros((len(map_T_cam), len(map_T_cam)))
    for view, pose in enumerate(map_T_cam):
        # The share of points along a frame's rays that each frame sees.
        x, y = np.meshgrid(*(side * half for half in extent_N2[view]))
        ray = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
        xyz = (depths[:, None, None] * ray).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
        cam = (xyz[None] - map_T_cam[:, None, :3, 3]) @ map_T_cam[:, :3, :3]
        ahead = cam[..., 2] > 1e-6
        at = np.abs(cam[..., :2] / np.where(ahead, cam[..., 2], 1.0)[..., None])
        share[view] = (ahead & (at <= extent_N2[:, None]).all(axis=2)).mean(axis=1)
    overlap = np.minimum(share, share.T)
    np.fill_diagonal(overlap, 0)
    best = np.argsort(-overlap, axis=1, kind="stable")[:, :per_frame]
    rows = np.repeat(np.arange(len(overlap)), best.shape[1])
    pairs = np.stack([rows, best.ravel()], axis=1)[overlap[rows, best.ravel()] > 0]
    return np.unique(np.sort(pairs, axis=1), axis=0)
