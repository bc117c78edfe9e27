"""Features of small grey images, and their matches."""

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array

LONG_SIDE = 400
_FEATURES = 500
_RATIO = 0.8

# SIFT positions (N, 2) with (0, 0) the image's corner, and descriptors (N, 128).
Features = tuple[Array, NDArray[np.float32]]


def detect_features(gray: NDArray[np.uint8]) -> Features:
    """The features of an image (H, W)."""
    points, descriptors = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(gray, None)
    positions = np.array([p.pt for p in points], dtype=float).reshape(-1, 2) + 0.5
    return positions, np.zeros((0, 128), np.float32) if descriptors is None else descriptors.astype(np.float32)


def match_features(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test, as index pairs (M, 2)."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.int64)
    forward = cv2.BFMatcher().knnMatch(a, b, k=2)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(b, a)}
    good = [m for m, n in forward if m.distance < _RATIO * n.distance and back.get(m.trainIdx) == m.queryIdx]
    return np.array([(m.queryIdx, m.trainIdx) for m in good], dtype=np.int64).reshape(-1, 2)
