"""Odometry that was written in other units or camera axes: every fused figure is wrong, and nothing else says so."""

from collections.abc import Sequence

import numpy as np

from groundwalk.consistency.motions import MIN_STEP_M, compare_motions
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.poses import Array, relative
from groundwalk.store import UserError

_MIN_STEP_NS = 3_000_000  # no camera takes 300 images a second
_APART_NS = 1_000_000_000  # frames so far apart show how a camera moves, and odometry hardly drifts in between
_FEW = 8  # fewer pairs may differ by chance
_MAX_RATIO = 2.0
_GL_T_CV = np.diag([1.0, -1.0, -1.0, 1.0])
_MAX_LEAN = np.radians(20.0)


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
