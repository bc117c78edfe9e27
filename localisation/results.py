"""What a localiser says of an image: a pose with its evidence, or a refusal with its reason."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, tq_from_pose
from groundwalk.store.choices import Refusal

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Seen:
    """M keypoints px (M, 2) that were matched with points: their rows in the localiser's points (M,), and which are
    inliers (M,)."""

    px: Array
    points: Ints
    inlier: NDArray[np.bool_]


NOTHING_SEEN = Seen(np.empty((0, 2)), np.empty(0, np.int64), np.empty(0, bool))


@dataclass(frozen=True)
class QueryResult:
    """A pose map_T_cam (4, 4) with its covariance (6, 6) of (rotation, position) in the map's axes, rad and m, where
    the localiser gives one; or neither, with the `refusal` and its `reason`, the figures.

    `candidates` keypoints were matched with points, `inliers` keypoints agree with the pose; `seen` has both.
    """

    map_T_cam: Array | None
    covariance: Array | None
    refusal: Refusal | None
    reason: str
    candidates: int
    inliers: int
    seen: Seen


def refused(
    refusal: Refusal, reason: str, candidates: int = 0, inliers: int = 0, seen: Seen = NOTHING_SEEN
) -> QueryResult:
    """An answer without a pose."""
    return QueryResult(None, None, refusal, reason, candidates, inliers, seen)


def of_another_size(grey: NDArray[np.uint8], camera: Camera) -> QueryResult | None:
    """The refusal of an image (H, W) whose intrinsics are for another size or orientation; None where they fit."""
    if grey.shape[:2] == (camera.height, camera.width):
        return None
    sizes = f"image {grey.shape[1]} x {grey.shape[0]} px, intrinsics for {camera.width} x {camera.height} px"
    return refused(Refusal.IMAGE_SIZE, sizes)


def seen_by(px: Array, points: Ints, matches: Ints, inliers: Ints) -> Seen:
    """What a query saw: `matches` (M, 2) and `inliers` (I, 2) are keypoints, rows of `px` (K, 2), and points, rows of
    `points` (C,); a match is an inlier or left out where its keypoint has one."""
    outliers = matches[~np.isin(matches[:, 0], inliers[:, 0])]
    both = np.concatenate([inliers, outliers])
    return Seen(px[both[:, 0]], points[both[:, 1]], np.arange(len(both)) < len(inliers))


def row_of(answer: QueryResult) -> dict[str, Any]:
    """An answer as plain values: position, m, and quaternion x, y, z, w of map_T_cam, and its covariance (36 numbers);
    or null, with the refusal and its reason."""
    row: dict[str, Any] = dict.fromkeys(("position_m", "quaternion", "covariance"))
    if answer.map_T_cam is not None:
        position, quaternion = tq_from_pose(answer.map_T_cam[None])
        row |= {"position_m": position[0].tolist(), "quaternion": quaternion[0].tolist()}
        row["covariance"] = None if answer.covariance is None else answer.covariance.ravel().tolist()
    counts = {"inliers": answer.inliers, "candidates": answer.candidates}
    return row | counts | {"refusal": answer.refusal, "reason": answer.reason or None}
