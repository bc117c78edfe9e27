"""What a session's motion says about its inputs: images and poses that belong together, focal length, folded places."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundwalk.consistency.motions import LEAST_STEP_M, LEAST_TURN, MotionAgreement, compare_motions
from groundwalk.consistency.trajectories import TrajectoryPair, path_m
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.geometry.poses import Array, relative, rotation_angle

TURN_GAIN_LIMIT = 0.03
"""A model may turn by this share more or less than VIO; a wrong focal length makes it do so."""
FOLDED_LIMIT = 0.03
"""Share of a session's frames that may lie where others do that VIO has far away."""

# How many frames on the next one that moved enough is looked for.
_FARTHEST = 60
# Places count as folded together where SfM has them at less than this share of the distance that VIO has.
_FOLDED_SHARE = 0.35
_ROWS_AT_ONCE = 500


@dataclass(frozen=True)
class Diagnosis:
    """A session's motions in SfM against those in VIO, and the share of its frames that lie where others do which VIO
    has far away (`folded`), with the largest such distance in metres."""

    frames: int
    motions: MotionAgreement
    folded: float
    folded_m: float


def diagnose(parts: Sequence[TrajectoryPair], drift: VioDrift) -> Diagnosis:
    """Diagnose one session's frames in one model; `parts` are its parts between all VIO jumps."""
    pairs = [_near_pairs(part.vio_T_cam) for part in parts]
    sfm, vio = (
        np.concatenate([relative(poses[a], poses[b]) for poses, (a, b) in zip(side, pairs, strict=True)])
        for side in ([s.sfm_T_cam for s in parts], [s.vio_T_cam for s in parts])
    )
    motions = compare_motions(sfm, vio, common_scale=True)
    scale = _step_scale(sfm, vio)
    frames = sum(len(part.vio_T_cam) for part in parts)
    folded, farthest, start = 0, 0.0, 0
    for part, (a, b) in zip(parts, pairs, strict=True):
        agree = motions.agree[start : start + len(a)]
        start += len(a)
        # A frame that is wrong alone agrees with none of its neighbours.
        right = ~np.isin(np.arange(len(part.vio_T_cam)), np.concatenate([a, b]))
        right[a[agree]] = right[b[agree]] = True
        if np.isfinite(scale) and right.any():
            count, metres = _folded(TrajectoryPair(part.sfm_T_cam[right], part.vio_T_cam[right]), scale, drift)
            folded, farthest = folded + count, max(farthest, metres)
    return Diagnosis(frames, motions, folded / max(frames, 1), farthest)


def _near_pairs(vio_T_cam: Array) -> tuple[np.ndarray, np.ndarray]:
    """Indices (P,), (P,) of each of the frames (n, 4, 4) and the next two that tell something of its motion: the first
    that turned or moved enough against it, and the one after. However densely a walk is sampled, the pairs are alike.
    """
    count = len(vio_T_cam)
    following = np.full(count, -1)
    for step in range(1, min(count, _FARTHEST + 1)):
        first = np.flatnonzero(following[:-step] < 0)
        if not len(first):
            break
        motion = relative(vio_T_cam[first], vio_T_cam[first + step])
        enough = np.linalg.norm(motion[:, :3, 3], axis=1) >= LEAST_STEP_M
        enough |= rotation_angle(motion[:, :3, :3]) >= LEAST_TURN
        following[first[enough]] = first[enough] + step
    a = np.flatnonzero(following >= 0)
    b = following[a]
    inside = b + 1 < count
    return np.concatenate([a, a[inside]]), np.concatenate([b, b[inside] + 1])


def _step_scale(sfm: Array, vio: Array) -> float:
    """VIO metres per SfM unit of near frames: a model that is folded far apart is right in most of these."""
    metres, units = (np.linalg.norm(step[:, :3, 3], axis=1) for step in (vio, sfm))
    moved = (metres > 0.1) & (units > 0)
    return float(np.median(metres[moved] / units[moved])) if moved.any() else float("nan")


def _folded(part: TrajectoryPair, scale: float, drift: VioDrift) -> tuple[int, float]:
    """How many frames lie where others do that VIO has far away, beyond all drift; and how far.

    Where a walk comes back, VIO is off by its drift in position and by what a heading that strayed on the way has done:
    the integral of the way there over the heading's error, at most that error times half of how far the way went.
    """
    sfm, vio, travelled = scale * part.sfm_T_cam[:, :3, 3], part.vio_T_cam[:, :3, 3], path_m(part.vio_T_cam)
    folded, farthest, place = np.zeros(len(vio), dtype=bool), 0.0, np.arange(len(vio))
    for start in range(0, len(vio), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        later = place[None] > place[rows, None]
        apart = np.linalg.norm(vio[rows, None] - vio[None], axis=2)
        found = np.linalg.norm(sfm[rows, None] - sfm[None], axis=2)
        between = np.abs(travelled[rows, None] - travelled[None])
        reach = np.maximum.accumulate(np.where(later, apart, 0.0), axis=1)
        allowed = 2 * drift.metres(between) + drift.radians(between) * reach / 2
        bad = later & (found < _FOLDED_SHARE * apart) & (apart - found > allowed)
        folded[rows] |= bad.any(axis=1)
        folded |= bad.any(axis=0)
        farthest = max(farthest, float(apart[bad].max(initial=0.0)))
    return int(folded.sum()), farthest
