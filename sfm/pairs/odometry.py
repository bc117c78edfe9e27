"""Relative poses of pairs of frames by images against those by VIO. Pure functions on arrays.

Within a session VIO gives the motion between two frames up to its drift, which grows with the path between them. Across
sessions it gives gravity alone: where each session began and which way it looked is unknown until the model is aligned.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.geometry.poses import Array, path_length, rotation_angle
from groundwalk.geometry.rows import evenly
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.store.choices import PairInconsistency

# Below this median angle between the rays of a pair's points its direction of motion is too uncertain to compare.
_MIN_TRIANGULATION = np.radians(3.0)
# A direction with a larger limit isn't compared.
_MAX_DIRECTION_LIMIT = np.radians(60.0)
# Two sessions' gravity differs where so many pairs between them or more (of many, so many are looked at), and this part
# of them, say by how much alike.
_MIN_DIFFERING_PAIRS, _MAX_DIFFERING_PAIRS, _MIN_DIFFERING_FRACTION = 10, 300, 0.7


@dataclass(frozen=True)
class Odometry:
    """VIO of N frames. Poses vio_T_cam (N, 4, 4) and gravity (N, 3, unit, camera axes) are NaN where it has none;
    `travelled_m`, `jumped_m` and `jumped_rad` (N,) add up path and jumps from the session's first frame on.
    `differing`: sessions, two by two, whose gravity can't be compared, as one of them has a wrong one."""

    session: NDArray[np.object_]
    vio_T_cam: Array
    gravity_cam: Array
    travelled_m: Array
    jumped_m: Array
    jumped_rad: Array
    differing: frozenset[frozenset[str]] = frozenset()

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(N,) which frames have a pose by VIO; none of a public data set's has."""
        return np.asarray(np.isfinite(self.vio_T_cam[:, 0, 0]), bool)


@dataclass(frozen=True)
class PairLimits:
    """What a pair's relative pose may differ by from VIO: `drift` over the path between its frames, and jumps there;
    `gravity_rad`, as gravity doesn't drift; `direction_rad`, the error of a direction of motion by two images."""

    drift: VioDrift
    gravity_rad: float
    direction_rad: float


@dataclass(frozen=True)
class VioComparison:
    """P pairs' two-view poses against VIO, angles in radians (P,), NaN where there is nothing to compare."""

    rotation: Array
    rotation_limit: Array
    direction: Array
    direction_limit: Array
    gravity: Array
    reason: NDArray[np.object_]

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """(P,) nothing of the pair is inconsistent with VIO."""
        return np.asarray(self.reason == PairInconsistency.NONE, bool)

    def assign(self, index: slice | NDArray[np.int64], other: "VioComparison") -> None:
        """Put the pairs of another comparison in the places `index`."""
        for column in fields(self):
            getattr(self, column.name)[index] = getattr(other, column.name)

    def scattered(self, index: NDArray[np.int64], count: int) -> "VioComparison":
        """This comparison as one of `count` pairs, of which those at `index` (P,) alone were compared."""
        whole = nothing_compared(count)
        whole.assign(index, self)
        return whole


def nothing_compared(pairs: int) -> VioComparison:
    """`pairs` pairs without a comparison, all of them consistent."""
    a, b, c, d, e = (np.full(pairs, np.nan) for _ in range(5))
    return VioComparison(a, b, c, d, e, np.full(pairs, PairInconsistency.NONE, object))


def odometry(
    session_N: NDArray[np.object_],
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
    return Odometry(session_N, vio_T_cam, gravity_cam, travelled, jumped_m, jumped_rad)


def motions_over(session_N: NDArray[np.object_], travelled_m: Array, length_m: float) -> Pairs:
    """Each frame with the nearest ones of its session that are at least so far on, and back, by VIO's path, (S, 2)."""
    motions = [np.empty((0, 2), np.int64)]
    for session in np.unique(session_N):
        rows = np.flatnonzero(session_N == session)
        rows = rows[np.argsort(travelled_m[rows], kind="stable")]
        path_m, index = travelled_m[rows], np.arange(len(rows))
        on = np.column_stack([index, np.searchsorted(path_m, path_m + length_m)])
        back = np.column_stack([np.searchsorted(path_m, path_m - length_m, side="right") - 1, index])
        ends = np.concatenate([on[on[:, 1] < len(rows)], back[back[:, 0] >= 0]])
        motions.append(rows[ends])
    return np.unique(np.concatenate(motions), axis=0)


def drift_between(vio: Odometry, pairs: Pairs, drift: VioDrift) -> tuple[Array, Array]:
    """What VIO can be off by between the two frames of each pair: metres (P,) and radians (P,)."""
    a, b = pairs.T
    path_m = np.abs(vio.travelled_m[a] - vio.travelled_m[b])
    metres = drift.metres(path_m) + np.abs(vio.jumped_m[a] - vio.jumped_m[b])
    radians = drift.radians(path_m) + np.abs(vio.jumped_rad[a] - vio.jumped_rad[b])
    return metres, radians


def compare_with_vio(
    pairs: Pairs, a_T_b: Array, triangulation_P: Array, vio: Odometry, limits: PairLimits
) -> VioComparison:
    """Two-view poses a_T_b (P, 4, 4; any length of translation, NaN for none) against VIO.

    Within a session the rotation and, where it is certain enough, the direction of motion are compared; gravity also
    across sessions. `triangulation_P` is the median angle (rad) between the rays of the pair's points.
    """
    a, b = pairs.T
    drift_m, drift_rad = drift_between(vio, pairs, limits.drift)
    drift_rad = np.minimum(drift_rad, np.pi)
    same = (vio.session[a] == vio.session[b]) & np.isfinite(a_T_b[:, 0, 0])
    same &= np.isfinite(vio.vio_T_cam[a, 0, 0]) & np.isfinite(vio.vio_T_cam[b, 0, 0])
    rotation, rotation_limit, direction, direction_limit, gravity = (np.full(len(pairs), np.nan) for _ in range(5))
    cam_R_vio = np.swapaxes(vio.vio_T_cam[:, :3, :3], 1, 2)
    if same.any():
        by_vio = cam_R_vio[a[same]] @ vio.vio_T_cam[b[same], :3, :3]
        rotation[same] = rotation_angle(np.swapaxes(a_T_b[same, :3, :3], 1, 2) @ by_vio)
        rotation_limit[same] = drift_rad[same]

    moved = vio.vio_T_cam[b, :3, 3] - vio.vio_T_cam[a, :3, 3]
    distance_m = np.linalg.norm(moved, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit = limits.direction_rad + drift_rad + np.arcsin(np.minimum(drift_m / distance_m, 1.0))
    has_direction = same & (triangulation_P > _MIN_TRIANGULATION) & (limit < _MAX_DIRECTION_LIMIT)
    if has_direction.any():
        by_vio = np.einsum("pij,pj->pi", cam_R_vio[a[has_direction]], moved[has_direction])
        direction[has_direction] = angles_between(a_T_b[has_direction, :3, 3], by_vio)
        direction_limit[has_direction] = limit[has_direction]

    gravity_b_in_a = np.einsum("pij,pj->pi", a_T_b[:, :3, :3], vio.gravity_cam[b])
    upright = np.isfinite(gravity_b_in_a).all(axis=1) & np.isfinite(vio.gravity_cam[a]).all(axis=1)
    if vio.differing:
        upright &= [frozenset(sessions) not in vio.differing for sessions in vio.session[pairs].tolist()]
    gravity[upright] = angles_between(gravity_b_in_a[upright], vio.gravity_cam[a[upright]])

    # Comparisons with NaN are false: what wasn't compared isn't inconsistent.
    beyond = [rotation > rotation_limit, gravity > limits.gravity_rad, direction > direction_limit]
    kinds = [PairInconsistency.ROTATION, PairInconsistency.GRAVITY, PairInconsistency.DIRECTION]
    reason = np.select(beyond, kinds, PairInconsistency.NONE).astype(object)
    return VioComparison(rotation, rotation_limit, direction, direction_limit, gravity, reason)


def differing_sessions(pairs: Pairs, a_T_b: Array, vio: Odometry, limit_rad: float) -> frozenset[frozenset[str]]:
    """Sessions, two by two, of which most pairs between them (relative poses a_T_b (P, 4, 4)) say that the one's
    gravity points in one and the same other direction in the other's world: a wrong gravity, not wrong pairs, which
    would say each another."""
    differing = set()
    ends = np.sort(vio.session[pairs].astype(str), axis=1)
    for one, other in sorted(set(map(tuple, ends[ends[:, 0] != ends[:, 1]].tolist()))):
        between = pairs[(ends == [one, other]).all(axis=1)]
        a_T_b_between = a_T_b[(ends == [one, other]).all(axis=1)]
        # Gravity of `one`, in the world of `other`, whichever of the two a pair has first.
        is_first = vio.session[between[:, 0]] == one
        from_one, to_other = np.where(is_first[:, None], between, between[:, ::-1]).T
        other_R_one = np.where(
            is_first[:, None, None], a_T_b_between.swapaxes(1, 2)[:, :3, :3], a_T_b_between[:, :3, :3]
        )
        down = np.einsum("pij,pj->pi", vio.vio_T_cam[to_other, :3, :3] @ other_R_one, vio.gravity_cam[from_one])
        down = down[np.isfinite(down).all(axis=1) & np.isfinite(vio.gravity_cam[to_other]).all(axis=1)]
        if len(down) < _MIN_DIFFERING_PAIRS:
            continue
        down = down[evenly(len(down), _MAX_DIFFERING_PAIRS)]
        near = angles_between(down[:, None], down[None]) <= limit_rad
        centre = down[near.sum(axis=0).argmax()]
        is_one_direction = near.sum(axis=0).max() >= _MIN_DIFFERING_FRACTION * len(down)
        if is_one_direction and angles_between(centre[None], np.array([[0.0, -1.0, 0.0]]))[0] > limit_rad:
            differing.add(frozenset((one, other)))
    return frozenset(differing)


def angles_between(u: Array, v: Array) -> Array:
    """Angles in radians (...) between vectors (..., 3); exact for small and large ones."""
    return np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.sum(u * v, axis=-1))
