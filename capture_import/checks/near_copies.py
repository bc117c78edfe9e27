"""Do test images show nearly what training images show? Asked of images without times, which say nothing of how near
they were taken."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import RawFrame, poses_of
from groundwalk.capture_import.checks.features import LONG_SIDE, Features, detect_features, match_features
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.store.parallel import in_parallel

# Every test image would take minutes where there are thousands, and the fraction is known from these.
_MAX_LOOKED_AT = 200
# Training images that each is compared with: the nearest of those that look the same way.
_NEAREST, _MAX_ANGLE_DEG = 3, 30.0
# Of neighbours in a walk round a chair, 6 degrees or 0.1 m apart, 31 % or more of the features match and move by 2 to
# 7 % of the image's width; 12 degrees apart, 19 to 30 % and 5 to 10 %.
_MIN_MATCHED, _MAX_MOVED = 0.25, 0.08
# A warning is due where more than this fraction has one: at the border between two parts of a walk some always have.
MAX_FRACTION = 0.05


@dataclass(frozen=True)
class NearCopies:
    """Of so many test images looked at, those with a near copy among the training images: their places, and its."""

    looked_at: int
    pairs: list[tuple[int, int]]


def find_near_copies(test: Sequence[RawFrame], train: Sequence[RawFrame], images: ImageReader) -> NearCopies:
    """The test images of which much of what is seen is at nearly the same place in a training image.

    All frames have poses, which choose what is compared; images decide."""
    tried = evenly(len(test), _MAX_LOOKED_AT)
    poses, of_train_poses = poses_of(test), poses_of(train)
    candidates = {int(i): _nearest(poses[i], of_train_poses) for i in tried}
    of_train = sorted({int(j) for nearest in candidates.values() for j in nearest})
    frames = [test[i] for i in candidates] + [train[j] for j in of_train]
    views = in_parallel(lambda view: (id(view[0]), detect_features(view[1])), images.gray(frames, LONG_SIDE))
    features: dict[int, Features] = dict(views)
    near = {
        i: [int(j) for j in nearest if _are_near(features.get(id(test[i])), features.get(id(train[j])))]
        for i, nearest in candidates.items()
    }
    return NearCopies(len(candidates), [(i, found[0]) for i, found in near.items() if found])


def _nearest(pose: Array, poses: Array) -> NDArray[np.int64]:
    """Places of the nearest of the poses (N, 4, 4) that look much the same way."""
    facing = np.flatnonzero(poses[:, :3, 2] @ pose[:3, 2] > np.cos(np.radians(_MAX_ANGLE_DEG)))
    distance = np.linalg.norm(poses[facing, :3, 3] - pose[:3, 3], axis=1)
    return facing[np.argsort(distance, kind="stable")[:_NEAREST]]


def _are_near(a: Features | None, b: Features | None) -> bool:
    if a is None or b is None:
        return False
    matches = match_features(a[1], b[1])
    if len(matches) < max(_MIN_MATCHED * min(len(a[0]), len(b[0])), 1):
        return False
    moved = np.linalg.norm(a[0][matches[:, 0]] - b[0][matches[:, 1]], axis=1)
    return float(np.median(moved)) < _MAX_MOVED * LONG_SIDE
