"""Features of small grey images, their matches, and test images that show nearly what training images show: asked of
images without times, which say nothing of how near they were taken."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import RawFrame, poses_of
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.store.parallel import in_parallel

LONG_SIDE = 400
_FEATURES = 500
_RATIO = 0.8

# SIFT positions (N, 2) with (0, 0) the image's corner, and descriptors (N, 128).
Features = tuple[Array, NDArray[np.float32]]
# Every test image would take minutes where there are thousands, and the fraction is known from these.
_MAX_LOOKED_AT = 200
# Training images that each is compared with: the nearest of those that look the same way.
_NEAREST, _MAX_ANGLE_DEG = 3, 30.0
# Of neighbours in a walk round a chair, 6 degrees or 0.1 m apart, 31 % or more of the features match and move by 2 to
# 7 % of the image's width; 12 degrees apart, 19 to 30 % and 5 to 10 %.
_MIN_MATCHED, _MAX_MOVED = 0.25, 0.08
# A warning is due where more than this fraction has one: at the border between two parts of a walk some always have.
MAX_FRACTION = 0.05


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


def find_near_copies(
    test: Sequence[RawFrame], train: Sequence[RawFrame], images: ImageReader
) -> tuple[int, list[tuple[int, int]]]:
    """How many test images were looked at, and the places of those of which much of what is seen is at nearly the same
    place in a training image, and its. All frames have poses, which choose what is compared; images decide."""
    tried = evenly(len(test), _MAX_LOOKED_AT)
    poses, of_train_poses = poses_of(test), poses_of(train)
    candidates: dict[int, list[int]] = {}
    for i in tried.tolist():
        facing = np.flatnonzero(of_train_poses[:, :3, 2] @ poses[i, :3, 2] > np.cos(np.radians(_MAX_ANGLE_DEG)))
        distance = np.linalg.norm(of_train_poses[facing, :3, 3] - poses[i, :3, 3], axis=1)
        candidates[i] = facing[np.argsort(distance, kind="stable")[:_NEAREST]].tolist()
    of_train = sorted({j for nearest in candidates.values() for j in nearest})
    frames = [test[i] for i in candidates] + [train[j] for j in of_train]
    views = in_parallel(lambda view: (id(view[0]), detect_features(view[1])), images.gray(frames, LONG_SIDE))
    features: dict[int, Features] = dict(views)
    near = {
        i: [j for j in nearest if _are_near(features.get(id(test[i])), features.get(id(train[j])))]
        for i, nearest in candidates.items()
    }
    return len(candidates), [(i, found[0]) for i, found in near.items() if found]


def _are_near(a: Features | None, b: Features | None) -> bool:
    if a is None or b is None:
        return False
    matches = match_features(a[1], b[1])
    if len(matches) < max(_MIN_MATCHED * min(len(a[0]), len(b[0])), 1):
        return False
    moved = np.linalg.norm(a[0][matches[:, 0]] - b[0][matches[:, 1]], axis=1)
    return float(np.median(moved)) < _MAX_MOVED * LONG_SIDE
