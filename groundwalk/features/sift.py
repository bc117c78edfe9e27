"""SIFT features of an image.

SIFT (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004) by OpenCV, which doubles the image
first, as RootSIFT (Arandjelović and Zisserman, "Three things everyone should know to improve object retrieval", CVPR
2012) in bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

DESCRIPTOR_SIZE = 128
_LENGTH = 512.0
_CELLS = 12  # of features that lie evenly, along the longer side


@dataclass(frozen=True)
class Features:
    """K keypoints: px (K, 2) of the full image, the first pixel's centre at (0.5, 0.5); their diameters (K,), px; their
    descriptors (K, D): RootSIFT's 128 bytes are of length 512, others' numbers of length 1."""

    px: NDArray[np.float32]
    size_px: NDArray[np.float32]
    descriptors: NDArray[Any]

    def __len__(self) -> int:
        return len(self.px)


def sift(grey: NDArray[np.uint8], max_features: int, max_side: int) -> Features:
    """The strongest features of a grey image (H, W), which is first shrunk to at most `max_side` pixels a side; the
    strongest first, so that a prefix is what fewer features would have been."""
    small, scale = shrunk(grey, max_side)
    return _strongest(small, scale, max_features, cv2.SIFT.create(nfeatures=max_features, enable_precise_upscale=True))


def masked_sift(grey: NDArray[np.uint8], mask: NDArray[np.uint8], max_features: int, contrast: float) -> Features:
    """As `sift`, of at least this contrast (OpenCV's contrastThreshold), where the mask (H, W) isn't 0; not shrunk."""
    detector = cv2.SIFT.create(nfeatures=max_features, contrastThreshold=contrast, enable_precise_upscale=True)
    return _strongest(grey, np.ones(2), max_features, detector, mask)


def _strongest(
    small: NDArray[np.uint8],
    scale: NDArray[np.float64],
    max_features: int,
    detector: cv2.SIFT,
    mask: NDArray[np.uint8] | None = None,
) -> Features:
    keypoints, rows = detector.detectAndCompute(small, mask)
    order = np.argsort([-k.response for k in keypoints], kind="stable")[:max_features]
    return _features([keypoints[i] for i in order], scale, None if rows is None else np.asarray(rows)[order])


def even_sift(grey: NDArray[np.uint8], max_features: int, max_side: int, contrast: float) -> Features:
    """As `sift`, of at least this contrast (OpenCV's contrastThreshold), but evenly over the image: the strongest of
    each cell of a grid, then the second of each, and so on."""
    small, scale = shrunk(grey, max_side)
    detector = cv2.SIFT.create(contrastThreshold=contrast, enable_precise_upscale=True)
    candidates = detector.detect(small, None)
    if not candidates:
        return _features([], scale, None)
    xy = np.array([k.pt for k in candidates])
    cell = (xy * _CELLS // max(small.shape)).astype(np.int64) @ [_CELLS, 1]
    response = np.array([k.response for k in candidates])
    order = np.lexsort([-response, cell])
    rank = np.empty(len(candidates), np.int64)
    rank[order] = np.arange(len(candidates)) - np.searchsorted(cell[order], cell[order])
    kept = np.lexsort([-response, rank])[:max_features]
    keypoints, rows = detector.compute(small, [candidates[i] for i in kept])
    return _features(keypoints, scale, rows)


def _features(keypoints: Sequence[cv2.KeyPoint], scale: NDArray[np.float64], rows: NDArray[Any] | None) -> Features:
    """Features of OpenCV's keypoints in a shrunk image and their SIFT descriptors (K, 128)."""
    if rows is None:
        rows = np.zeros((0, DESCRIPTOR_SIZE))
    px = (np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5) * scale
    size = np.array([k.size for k in keypoints]) * scale.mean()
    # RootSIFT descriptors (K, 128) of length 512 in bytes
    sift = np.asarray(rows, np.float32)
    rooted = np.rint(_LENGTH * np.sqrt(sift / np.maximum(sift.sum(axis=1, keepdims=True), 1e-9)))
    return Features(px.astype(np.float32), size.astype(np.float32), np.minimum(rooted, 255).astype(np.uint8))


def shrunk(grey: NDArray[np.uint8], max_side: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A grey image (H, W) with at most `max_side` pixels a side, and how many pixels of the image one of it is, (2,), x
    and y."""
    factor = min(1.0, max_side / max(grey.shape))
    small = grey
    if factor < 1:
        width, height = (round(side * factor) for side in (grey.shape[1], grey.shape[0]))
        small = np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return small, np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])
