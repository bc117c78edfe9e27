"""Quaternions that were written w first: they look like others, and make every figure meaningless without a word."""

from collections.abc import Callable, Sequence

import numpy as np

from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.poses import Array, pose_from_tq, tq_from_pose
from groundwalk.scoring.errors import relative_error, rotation_error_deg
from groundwalk.store import UserError

_FEW = 10  # fewer errors may fit by chance
_CLOSER = 4.0  # by this factor, and ...
_FAR_DEG = 60.0  # ... beyond this from the ground truth a prediction has the other order; ...
_FAR_STEP_DEG = 10.0  # ... ground truth and odometry beyond this in a step


def refuse_scalar_first(walks: Sequence[Walk], scene: str) -> None:
    """Raise UserError where a table's quaternions fit the others only when read as w, x, y, z.

    Predictions are held against ground truth, ground truth and odometry against each other's turns.
    """
    # Of each walk the frames that have both poses, and which of their steps are between neighbours.
    tracked = [np.flatnonzero(known(w.map_T_cam) & known(w.vio_T_cam)) for w in walks]
    steps = [(w.map_T_cam[f], w.vio_T_cam[f], np.diff(f) == 1) for w, f in zip(walks, tracked, strict=True)]

    def turns(read_truth: Callable[[Array], Array], read_vio: Callable[[Array], Array]) -> float:
        return _median([relative_error(read_truth(true), read_vio(vio))[1][near] for true, vio, near in steps])

    given = turns(_as_given, _as_given)
    if given > _FAR_STEP_DEG:
        for what, read_truth, read_vio in (
            ("ground truth", _as_w_first, _as_given),
            ("frames", _as_given, _as_w_first),
            ("frames and ground truth", _as_w_first, _as_w_first),
        ):
            _refuse_if_closer(given, turns(read_truth, read_vio), f"{what} of {scene}")
    both = [known(w.map_T_cam_predicted) & known(w.map_T_cam) for w in walks]
    true = np.concatenate([w.map_T_cam[there] for w, there in zip(walks, both, strict=True)])
    predicted = np.concatenate([w.map_T_cam_predicted[there] for w, there in zip(walks, both, strict=True)])
    given = _median([rotation_error_deg(predicted, true)])
    if given > _FAR_DEG:
        _refuse_if_closer(given, _median([rotation_error_deg(_as_w_first(predicted), true)]), f"predictions of {scene}")


def _as_given(poses: Array) -> Array:
    return poses


def _as_w_first(poses: Array) -> Array:
    """Poses (N, 4, 4) if what was read as x, y, z, w had been written as w, x, y, z."""
    t, q = tq_from_pose(poses)
    return pose_from_tq(t, q[:, [1, 2, 3, 0]])


def _median(errors: Sequence[Array]) -> float:
    """The median of all, NaN of few."""
    together = np.concatenate([np.empty(0), *errors])
    return float(np.median(together)) if len(together) >= _FEW else float("nan")


def _refuse_if_closer(given: float, w_first: float, what: str) -> None:
    if w_first * _CLOSER < given:
        raise UserError(
            f"{what}: quaternions look like w, x, y, z",
            expected="columns _qx, _qy, _qz, _qw in their own places",
            found=f"rotations off by {given:.0f} degrees (median), and by {w_first:.1f} read in the other order",
            do="write the scalar part into column _qw",
        )
