"""Do test images show nearly what training images show? Asked of images without times, which say nothing of how near
they were taken."""

from collections.abc import Sequence

import numpy as np

from groundwalk.capture_import.capture import RawFrame, poses_of
from groundwalk.capture_import.checks.features import LONG_SIDE, Features, detect_features, match_features
from groundwalk.capture_import.media.reading import ImageReader
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
