"""Tables in other units, camera axes or orders of quaternions: every figure is wrong, and nothing else says so."""

from collections.abc import Callable, Sequence

import numpy as np

from groundwalk.consistency.motions import MIN_STEP_M, compare_motions
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.poses import Array, pose_from_tq, relative, tq_from_pose
from groundwalk.scoring.errors import relative_error, rotation_error_deg
from groundwalk.store import UserError

_MIN_STEP_NS = 3_000_000  # no camera takes 300 images a second
_APART_NS = 1_000_000_000  # frames so far apart show how a camera moves, and odometry hardly drifts in between
_FEW = 8  # fewer pairs may differ by chance
_MAX_RATIO = 2.0
_GL_T_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_MAX_LEAN = np.radians(20.0)
_FEW_TURNS = 10  # fewer errors may fit by chance
_CLOSER = 4.0  # by this factor, and ...
_FAR_DEG = 60.0  # ... beyond this from the ground truth a prediction has the other order; ...
_FAR_STEP_DEG = 10.0  # ... ground truth and odometry beyond this in a step


def refuse_other_conventions(walks: Sequence[Walk], scene: str) -> None:
    """Raise UserError where times of walks with odometry aren't nanoseconds, or odometry has other camera axes than
    ground truth or another unit."""
    steps_ns = np.concatenate([np.empty(0), *(np.diff(walk.t_ns) for walk in walks)])
    if len(steps_ns) and np.median(steps_ns) < _MIN_STEP_NS:
        raise UserError(
            f"frames of {scene}: times aren't nanoseconds",
            where="column t_ns",
            found=f"frames {np.median(steps_ns):.0f} ns apart (median)",
            do="multiply seconds by 1e9, milliseconds by 1e6, microseconds by 1e3",
        )
    true, vio = _motions(walks)
    gl = compare_motions(true, _GL_T_CV @ vio @ _GL_T_CV, common_scale=False)
    if compare_motions(true, vio, common_scale=False).mistake and not gl.mistake:
        raise UserError(
            f"odometry of {scene} moves along other axes than its ground truth",
            where="columns vio_cam_* of the frames",
            expected="poses of the camera: x right, y down, z forward",
            found=f"{gl.explained:.0%} of {gl.pairs} motions of a second agree if one of both has x right, y up, "
            "z back, as ARKit and OpenGL do",
            do="multiply those poses from the right by diag(1, -1, -1, 1)",
        )
    length_m, vio_m = (np.linalg.norm(poses[:, :3, 3], axis=1) for poses in (true, vio))
    moved = length_m >= MIN_STEP_M
    ratio = float(np.median(vio_m[moved] / length_m[moved])) if moved.sum() >= _FEW else 1.0
    if not 1 / _MAX_RATIO < ratio < _MAX_RATIO:
        raise UserError(
            f"odometry of {scene} isn't in metres",
            where="columns vio_cam_tx, _ty, _tz of the frames",
            found=f"motions {ratio:.3g} times as long as the ground truth's (median of {moved.sum()})",
            do="convert positions to metres; odometry without metric scale can't be fused",
        )


def refuse_unrelated(walks: Sequence[Walk], scene: str) -> None:
    """Raise UserError where odometry moves in no relation to ground truth."""
    motions = compare_motions(*_motions(walks), common_scale=False)
    if motions.mistake:
        raise UserError(
            f"odometry of {scene} moves unlike its ground truth",
            where="columns vio_cam_* of the frames",
            found=f"{motions.explained:.0%} of {motions.pairs} motions of a second agree",
            do="check that both are of the same frames, and poses of the camera in the world",
        )


def shares_vertical(map_T_cam: Array, vio_T_cam: Array) -> bool:
    """Whether +y of odometry and of ground truth, poses (N, 4, 4) or NaN, are one direction, as far as they tell."""
    both = known(map_T_cam) & known(vio_T_cam)
    up = np.sum(map_T_cam[both, 1, :3] * vio_T_cam[both, 1, :3], axis=1)
    return len(up) < _FEW or bool(np.median(up) > np.cos(_MAX_LEAN))


def _motions(walks: Sequence[Walk]) -> tuple[Array, Array]:
    """Motions (P, 4, 4) over a second by ground truth and by odometry."""
    true, vio = [np.empty((0, 4, 4))], [np.empty((0, 4, 4))]
    for walk in walks:
        both = np.flatnonzero(known(walk.map_T_cam) & known(walk.vio_T_cam))
        later = np.searchsorted(walk.t_ns[both], walk.t_ns[both] + _APART_NS)
        a, b = both[later < len(both)], both[later[later < len(both)]]
        true.append(relative(walk.map_T_cam[a], walk.map_T_cam[b]))
        vio.append(relative(walk.vio_T_cam[a], walk.vio_T_cam[b]))
    return np.concatenate(true), np.concatenate(vio)


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
    return float(np.median(together)) if len(together) >= _FEW_TURNS else float("nan")


def _refuse_if_closer(given: float, w_first: float, what: str) -> None:
    if w_first * _CLOSER < given:
        raise UserError(
            f"{what}: quaternions look like w, x, y, z",
            expected="columns _qx, _qy, _qz, _qw in their own places",
            found=f"rotations off by {given:.0f} degrees (median), and by {w_first:.1f} read in the other order",
            do="write the scalar part into column _qw",
        )
