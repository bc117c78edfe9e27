"""What a session's motion says about its inputs: images and poses that belong together, focal length, folded places."""

from dataclasses import dataclass

import numpy as np

from alignment.agreement import Allowance
from alignment.segments import Segment
from geometry.motion_agreement import MotionAgreement, compare_motions
from geometry.poses import Array, relative

# Motions are compared between each frame and so many next ones.
_NEXT = 2
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


def diagnose(pieces: list[Segment], allowance: Allowance) -> Diagnosis:
    """Diagnose one session's frames in one model; `pieces` are its parts between all VIO jumps."""
    known = [piece.where(piece.both) for piece in pieces]
    pairs = [_near_pairs(len(piece.rows)) for piece in known]
    sfm, vio = (
        np.concatenate([relative(poses(piece)[a], poses(piece)[b]) for piece, (a, b) in zip(known, pairs, strict=True)])
        for poses in (lambda piece: piece.sfm_T_cam, lambda piece: piece.vio_T_cam)
    )
    motions = compare_motions(sfm, vio, common_scale=True)
    scale = _step_scale(sfm, vio)
    frames = sum(len(piece.rows) for piece in known)
    folded, farthest, start = 0, 0.0, 0
    for piece, (a, b) in zip(known, pairs, strict=True):
        agree = motions.agree[start : start + len(a)]
        start += len(a)
        # A frame that is wrong alone agrees with none of its neighbours.
        right = np.zeros(len(piece.rows), dtype=bool)
        right[a[agree]] = right[b[agree]] = True
        if np.isfinite(scale) and right.any():
            count, metres = _folded(piece.where(right), scale, allowance)
            folded, farthest = folded + count, max(farthest, metres)
    return Diagnosis(frames, motions, folded / max(frames, 1), farthest)


def _near_pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (P,), (P,) of each of `count` frames and the next ones."""
    first = [np.arange(max(count - step, 0)) for step in range(1, _NEXT + 1)]
    return np.concatenate(first), np.concatenate([of + step for step, of in enumerate(first, 1)])


def _step_scale(sfm: Array, vio: Array) -> float:
    """VIO metres per SfM unit of near frames: a model that is folded far apart is right in most of these."""
    metres, units = (np.linalg.norm(step[:, :3, 3], axis=1) for step in (vio, sfm))
    moved = (metres > 0.1) & (units > 0)
    return float(np.median(metres[moved] / units[moved])) if moved.any() else float("nan")


def _folded(piece: Segment, scale: float, allowance: Allowance) -> tuple[int, float]:
    """How many frames lie where others do that VIO has far away, beyond all drift; and how far."""
    sfm, vio, travelled = scale * piece.sfm_T_cam[:, :3, 3], piece.vio_T_cam[:, :3, 3], piece.travelled_m
    folded, farthest = np.zeros(len(vio), dtype=bool), 0.0
    for start in range(0, len(vio), _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        apart = np.linalg.norm(vio[rows, None] - vio[None], axis=2)
        found = np.linalg.norm(sfm[rows, None] - sfm[None], axis=2)
        path = np.abs(travelled[rows, None] - travelled[None])
        allowed = allowance.position_m + allowance.position_per_m * path
        bad = (found < _FOLDED_SHARE * apart) & (apart - found > 2 * allowed)
        folded[rows] = bad.any(axis=1)
        farthest = max(farthest, float(apart[bad].max(initial=0.0)))
    return int(folded.sum()), farthest
