"""A session's motion in SfM against VIO: do images and poses belong together, its focal length, perceptual aliasing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundwalk.consistency.motions import MIN_STEP_M, MIN_TURN, MotionAgreement, compare_motions
from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.consistency.vio_drift import drift_m, drift_rad
from groundwalk.geometry.poses import Array, relative, rotation_angle

MAX_TURN_GAIN_ERROR = 0.03
"""Fraction by which a model may turn more or less than VIO; a wrong focal length makes it do so."""
MAX_ALIASED_FRACTION = 0.03
"""Fraction of a session's frames that may lie where others do that are far away in VIO."""

# The next frame that moved enough is looked for among so many.
_MAX_FRAMES_APART = 60
# Distinct places are merged where they are nearer in SfM than this fraction of their distance in VIO.
_MAX_DISTANCE_RATIO = 0.35
_ROWS_AT_ONCE = 500


@dataclass(frozen=True)
class Diagnosis:
    """A session's motions in SfM against those in VIO; the fraction of its frames that lie where others do that are far
    away in VIO, and the largest such distance in metres."""

    frames: int
    motions: MotionAgreement
    aliased_fraction: float
    aliased_m: float


def diagnose(parts: Sequence[TrajectoryPair]) -> Diagnosis:
    """Diagnose one session's frames in one model; `parts` are its parts between all VIO jumps."""
    pairs = [_near_pairs(part.vio_T_cam) for part in parts]
    sfm, vio = (
        np.concatenate([relative(poses[a], poses[b]) for poses, (a, b) in zip(trajectories, pairs, strict=True)])
        for trajectories in ([p.sfm_T_cam for p in parts], [p.vio_T_cam for p in parts])
    )
    motions = compare_motions(sfm, vio, common_scale=True)
    # VIO metres per SfM unit, by near frames: most of these are right in a model that merges places far apart.
    metres, units = (np.linalg.norm(step[:, :3, 3], axis=1) for step in (vio, sfm))
    moved = (metres > 0.1) & (units > 0)
    scale = float(np.median(metres[moved] / units[moved])) if moved.any() else float("nan")
    frames = sum(len(part.vio_T_cam) for part in parts)
    aliased, max_distance_m, start = 0, 0.0, 0
    for part, (a, b) in zip(parts, pairs, strict=True):
        agree = motions.agree[start : start + len(a)]
        start += len(a)
        # A frame that is wrong alone agrees with none of its neighbours.
        is_right = ~np.isin(np.arange(len(part.vio_T_cam)), np.concatenate([a, b]))
        is_right[a[agree]] = is_right[b[agree]] = True
        if np.isfinite(scale) and is_right.any():
            right = TrajectoryPair(*(each[is_right] for each in part))
            count, distance_m = _aliased(right, scale)
            aliased, max_distance_m = aliased + count, max(max_distance_m, distance_m)
    return Diagnosis(frames, motions, aliased / max(frames, 1), max_distance_m)


def _near_pairs(vio_T_cam: Array) -> tuple[np.ndarray, np.ndarray]:
    """Indices (P,), (P,) of each of the frames (n, 4, 4) and two later ones: the first that turned or moved enough
    against it, and the one after. However densely a walk is sampled, the pairs are alike.
    """
    count = len(vio_T_cam)
    following = np.full(count, -1)
    for step in range(1, min(count, _MAX_FRAMES_APART + 1)):
        first = np.flatnonzero(following[:-step] < 0)
        if not len(first):
            break
        motion = relative(vio_T_cam[first], vio_T_cam[first + step])
        enough = np.linalg.norm(motion[:, :3, 3], axis=1) >= MIN_STEP_M
        enough |= rotation_angle(motion[:, :3, :3]) >= MIN_TURN
        following[first[enough]] = first[enough] + step
    a = np.flatnonzero(following >= 0)
    b = following[a]
    inside = b + 1 < count
    return np.concatenate([a, a[inside]]), np.concatenate([b, b[inside] + 1])


def _aliased(part: TrajectoryPair, scale: float) -> tuple[int, float]:
    """How many frames lie where others do that are far away in VIO, beyond its drift; and the largest distance, metres.

    Where a walk comes back, VIO is off by its drift in position, and by what the error of its heading did on the way:
    the integral of the path over the heading's error, at most that error times half of the distance reached.
    """
    sfm, vio = scale * part.sfm_T_cam[:, :3, 3], part.vio_T_cam[:, :3, 3]
    travelled = part.travelled_m
    aliased, max_distance_m, index = np.zeros(len(vio), dtype=bool), 0.0, np.arange(len(vio))
    for start in range(0, len(vio), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        later = index[None] > index[rows, None]
        vio_m = np.linalg.norm(vio[rows, None] - vio[None], axis=2)
        sfm_m = np.linalg.norm(sfm[rows, None] - sfm[None], axis=2)
        between = np.abs(travelled[rows, None] - travelled[None])
        reach = np.maximum.accumulate(np.where(later, vio_m, 0.0), axis=1)
        limit_m = 2 * drift_m(between) + drift_rad(between) * reach / 2
        merged = later & (sfm_m < _MAX_DISTANCE_RATIO * vio_m) & (vio_m - sfm_m > limit_m)
        aliased[rows] |= merged.any(axis=1)
        aliased |= merged.any(axis=0)
        max_distance_m = max(max_distance_m, float(vio_m[merged].max(initial=0.0)))
    return int(aliased.sum()), max_distance_m
