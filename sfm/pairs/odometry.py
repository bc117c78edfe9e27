"""Relative poses of pairs of frames by images against those by VIO. Pure functions on arrays.

Within a session VIO gives the motion between two frames up to its drift, which grows with the path between them. Across
sessions it gives gravity alone: where each session began and which way it looked is unknown until the model is aligned.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.consistency.vio_drift import drift_m, drift_rad
from groundwalk.geometry.poses import Array, path_length, rotation_angle
from groundwalk.geometry.rows import evenly
from groundwalk.store.choices import PairInconsistency

Pairs = NDArray[np.int64]
# A pair is inconsistent where gravity differs by more between its frames: gravity doesn't drift.
GRAVITY_LIMIT = float(np.radians(5.0))
# Error of a pair's direction of motion by its images; VIO's drift adds to it.
_DIRECTION_LIMIT = float(np.radians(15.0))
# Below this median angle between the rays of a pair's points its direction of motion is too uncertain to compare.
_MIN_TRIANGULATION = np.radians(3.0)
# A direction with a larger limit isn't compared.
_MAX_DIRECTION_LIMIT = np.radians(60.0)
# Two sessions' gravity differs where so many pairs between them or more (of many, so many are looked at), and this part
# of them, say by how much alike.
_MIN_TILTED_PAIRS, _MAX_TILTED_PAIRS, _MIN_TILTED_FRACTION = 10, 300, 0.7


@dataclass(frozen=True)
class Odometry:
    """VIO of N frames, each of a session of a recording (N,), and their times `t_ns` (N,). Poses vio_T_cam (N, 4, 4)
    and gravity (N, 3, unit, camera axes) are NaN where it has none; `travelled_m`, `jumped_m` and `jumped_rad` (N,) add
    up path and jumps from the session's first frame on. `tilted`: sessions, two by two, whose gravity can't be
    compared, as one of them has a wrong one."""

    session: NDArray[np.object_]
    recording: NDArray[np.object_]
    t_ns: NDArray[np.int64]
    vio_T_cam: Array
    gravity_cam: Array
    travelled_m: Array
    jumped_m: Array
    jumped_rad: Array
    tilted: frozenset[frozenset[str]] = frozenset()

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(N,) which frames have a pose by VIO; none of a public data set's has."""
        return np.asarray(np.isfinite(self.vio_T_cam[:, 0, 0]), bool)

    def longest_session(self) -> Array:
        """vio_T_cam (N, 4, 4) of the session that has most poses, NaN for all other frames."""
        sessions, counts = np.unique(self.session[self.posed].astype(str), return_counts=True)
        chosen = self.posed & (self.session == sessions[np.argmax(counts)])
        return np.where(chosen[:, None, None], self.vio_T_cam, np.nan)


def odometry(
    session_N: NDArray[np.object_],
    recording_N: NDArray[np.object_],
    t_ns_N: NDArray[np.int64],
    vio_T_cam: Array,
    gravity_cam: Array,
    jumps: Iterable[tuple[str, int, float, float]],
) -> Odometry:
    """`jumps` are (session, time of the first pose after it in ns, metres, radians)."""
    travelled, jumped_m, jumped_rad = (np.zeros(len(session_N)) for _ in range(3))
    for session in np.unique(session_N):
        rows = np.flatnonzero(session_N == session)
        rows = rows[np.argsort(t_ns_N[rows], kind="stable")]
        posed = rows[np.isfinite(vio_T_cam[rows, 0, 0])]
        if len(posed):
            travelled[rows] = np.interp(t_ns_N[rows], t_ns_N[posed], path_length(vio_T_cam[posed, :3, 3]))
    for session, t_ns, metres, radians in jumps:
        after = (session_N == session) & (t_ns_N >= t_ns)
        jumped_m[after] += metres
        jumped_rad[after] += radians
    return Odometry(session_N, recording_N, t_ns_N, vio_T_cam, gravity_cam, travelled, jumped_m, jumped_rad)


def drift_between(vio: Odometry, pairs: Pairs) -> tuple[Array, Array]:
    """What VIO can be off by between the two frames of each pair: metres (P,) and radians (P,)."""
    a, b = pairs.T
    path_m = np.abs(vio.travelled_m[a] - vio.travelled_m[b])
    metres = drift_m(path_m) + np.abs(vio.jumped_m[a] - vio.jumped_m[b])
    radians = drift_rad(path_m) + np.abs(vio.jumped_rad[a] - vio.jumped_rad[b])
    return metres, radians


def compare_with_vio(pairs: Pairs, a_T_b: Array, triangulation_P: Array, vio: Odometry) -> pd.DataFrame:
    """Two-view poses a_T_b (P, 4, 4; any length of translation, NaN for none) against VIO.

    Within a session the rotation and, where it is certain enough, the direction of motion are compared; gravity also
    across sessions. `triangulation_P` is the median angle (rad) between the rays of the pair's points. A row a pair:
    angles in radians, NaN where there is nothing to compare, and the `reason` against it (PairInconsistency).
    """
    a, b = pairs.T
    drift_m, drift_rad = drift_between(vio, pairs)
    drift_rad = np.minimum(drift_rad, np.pi)
    same = (vio.session[a] == vio.session[b]) & np.isfinite(a_T_b[:, 0, 0]) & vio.posed[a] & vio.posed[b]
    cam_R_vio = np.swapaxes(vio.vio_T_cam[:, :3, :3], 1, 2)
    a_R_b_by_vio = cam_R_vio[a[same]] @ vio.vio_T_cam[b[same], :3, :3]
    rotation = np.full(len(pairs), np.nan)
    rotation[same] = rotation_angle(np.swapaxes(a_T_b[same, :3, :3], 1, 2) @ a_R_b_by_vio)

    moved = vio.vio_T_cam[b, :3, 3] - vio.vio_T_cam[a, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        heading_rad = np.arcsin(np.minimum(drift_m / np.linalg.norm(moved, axis=1), 1.0))
    limit = _DIRECTION_LIMIT + drift_rad + heading_rad
    has_direction = same & (triangulation_P > _MIN_TRIANGULATION) & (limit < _MAX_DIRECTION_LIMIT)
    direction = angles_between(a_T_b[:, :3, 3], np.einsum("pij,pj->pi", cam_R_vio[a], moved))

    gravity = angles_between(np.einsum("pij,pj->pi", a_T_b[:, :3, :3], vio.gravity_cam[b]), vio.gravity_cam[a])
    if vio.tilted:
        gravity[[frozenset(sessions) in vio.tilted for sessions in vio.session[pairs].tolist()]] = np.nan

    compared = pd.DataFrame(
        {
            "rotation": rotation,
            "rotation_limit": np.where(same, drift_rad, np.nan),
            "direction": np.where(has_direction, direction, np.nan),
            "direction_limit": np.where(has_direction, limit, np.nan),
            "gravity": gravity,
        }
    )
    # Comparisons with NaN are false: what wasn't compared isn't inconsistent.
    beyond = [
        compared["rotation"] > compared["rotation_limit"],
        compared["gravity"] > GRAVITY_LIMIT,
        compared["direction"] > compared["direction_limit"],
    ]
    kinds = [PairInconsistency.ROTATION, PairInconsistency.GRAVITY, PairInconsistency.DIRECTION]
    return compared.assign(reason=np.select(beyond, kinds, PairInconsistency.NONE).astype(object))


def without_tilted(vio: Odometry, pairs: Pairs, a_T_b: Array) -> Odometry:
    """VIO with its `tilted` sessions: two by two those of which most pairs (P, 2) between them, of relative poses
    a_T_b (P, 4, 4), say that the one's gravity points in one and the same other direction in the other's world: a wrong
    gravity, not wrong pairs, which would say each another."""
    tilted = set()
    ends = np.sort(vio.session[pairs].astype(str), axis=1)
    for one, other in np.unique(ends[ends[:, 0] != ends[:, 1]], axis=0).tolist():
        members = (ends == [one, other]).all(axis=1)
        between, a_R_b = pairs[members], a_T_b[members, :3, :3]
        # Gravity of `one`, in the world of `other`, whichever of the two a pair has first.
        is_first = vio.session[between[:, 0]] == one
        from_one, to_other = np.where(is_first[:, None], between, between[:, ::-1]).T
        other_R_one = np.where(is_first[:, None, None], a_R_b.swapaxes(1, 2), a_R_b)
        down = np.einsum("pij,pj->pi", vio.vio_T_cam[to_other, :3, :3] @ other_R_one, vio.gravity_cam[from_one])
        down = down[np.isfinite(down).all(axis=1) & np.isfinite(vio.gravity_cam[to_other]).all(axis=1)]
        if len(down) < _MIN_TILTED_PAIRS:
            continue
        down = down[evenly(len(down), _MAX_TILTED_PAIRS)]
        agreeing = (angles_between(down[:, None], down[None]) <= GRAVITY_LIMIT).sum(axis=0)
        centre = down[agreeing.argmax()]
        is_one_direction = agreeing.max() >= _MIN_TILTED_FRACTION * len(down)
        if is_one_direction and angles_between(centre[None], np.array([[0.0, -1.0, 0.0]]))[0] > GRAVITY_LIMIT:
            tilted.add(frozenset((one, other)))
    return replace(vio, tilted=frozenset(tilted))


def angles_between(u: Array, v: Array) -> Array:
    """Angles in radians (...) between vectors (..., 3); exact for small and large ones."""
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1))
