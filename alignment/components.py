"""Several SfM models of one scene: each metric and upright on its own, all put into one map where VIO ties them."""

from dataclasses import dataclass

import numpy as np

from groundwalk.alignment.checks import UNCERTAIN, About, Check, check
from groundwalk.alignment.map_frame import MapScale, Vertical
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.consistency.windows import PoseSd, fit_rigid
from groundwalk.geometry.fits import Sim3, rotation_to_up
from groundwalk.geometry.poses import Array, heading, inverse, transform

_LEAST_FRAMES = 3


@dataclass(frozen=True)
class Model:
    """One SfM model's frames in parts of sessions; `pieces` are cut at all VIO jumps."""

    name: str
    segments: list[Segment]
    pieces: list[Segment]


@dataclass(frozen=True)
class Component:
    """One SfM model: its frames in parts of sessions (`pieces` are cut at all VIO jumps), its scale and vertical.
    `vio_scale` is its scale by VIO alone, the same unless a ruler or a reference sets the scale."""

    index: int
    model_id: str
    segments: list[Segment]
    pieces: list[Segment]
    scale: MapScale
    vertical: Vertical
    vio_scale: MapScale

    @property
    def metric_S_sfm(self) -> Sim3:
        """Metric and upright; origin and heading as they come."""
        return Sim3(float(np.exp(self.scale.log)), rotation_to_up(self.vertical.up_sfm), np.zeros(3))

    @property
    def frames(self) -> int:
        return sum(int(s.registered.sum()) for s in self.segments)


def check_standard_errors(component: Component, settings: AlignSettings) -> list[Check]:
    """The standard errors of a model's scale and vertical against what they may be: too large a one is not wrong, but
    leaves it undecided. It says nothing of single frames; the headline and each frame's whole covariance have it."""
    scale, vertical = component.scale, component.vertical
    checks = []
    by = "reference" if scale.reference else "map"
    for name, sd, limit in (
        (f"{by}_scale", scale.sd if scale.is_known else np.nan, settings.max_scale_sd),
        (f"{by}_vertical", float(np.degrees(vertical.sd)), settings.max_vertical_sd_deg),
    ):
        status = Status.PASSED if sd <= limit else Status.UNDECIDED
        about = About(component.frames, component=component.index)
        checks.append(check(name, sd, None, limit, about, UNCERTAIN, "", status=status))
    return checks


@dataclass(frozen=True)
class BridgeSd:
    """One sigma of what VIO drifts by over a metre: position in metres, heading in radians; it grows with the root."""

    position_m: float
    heading: float


@dataclass(frozen=True)
class Bridge:
    """How VIO ties a component to what is in the map: through a session, over `gap_m` of its path without a frame of
    either; about `anchor` (3,) in the map the component may be turned and shifted by the sigmas."""

    session_id: str
    gap_m: float
    path_m: float
    anchor: Array
    position_sd_m: float
    heading_sd: float


@dataclass(frozen=True)
class Placed:
    """A component in the map; the first one has no bridge."""

    component: Component
    map_S_sfm: Sim3
    bridge: Bridge | None = None


@dataclass(frozen=True)
class Untied:
    """A component that isn't in the map, and why: `gap_m` is the shortest way along a session to what is, if any."""

    component: Component
    gap_m: float | None
    reason: str


def place_components(
    components: list[Component],
    used: np.ndarray,
    *,
    window_m: float,
    longest_m: float,
    drift: VioDrift,
    sd: PoseSd,
    bridge_sd: BridgeSd,
) -> tuple[list[Placed], list[Untied]]:
    """Put components (largest first) into one map. `used` (N,) are the frames of the frames table to go by.

    The first component gives origin and heading. Each other one is tied by VIO alone, through a session that has frames
    in it and in the map, by the shortest way of at most `longest_m`; `window_m` around there are fitted on both sides.
    Ways through several sessions must agree within what VIO may drift by.
    """
    first = components[0]
    # Without a scale positions say nothing of the heading.
    first_sd = sd if first.scale.is_known else PoseSd(np.inf, sd.rotation)
    placed = [Placed(first, _origin(first.segments, first.metric_S_sfm, used, first_sd) @ first.metric_S_sfm)]
    waiting = list(components[1:])
    ways: dict[int, list[tuple[Bridge, Sim3]]] = {}
    while waiting:
        ways = {
            c.index: sorted(
                (way for p in placed for way in _ways(p, c, used, window_m, sd, bridge_sd)),
                key=lambda way: way[0].gap_m,
            )
            for c in waiting
        }
        near = [c for c in waiting if ways[c.index] and ways[c.index][0][0].gap_m <= longest_m]
        near = [c for c in near if not _contradiction(ways[c.index], longest_m, drift)]
        if not near:
            break
        best = min(near, key=lambda c: ways[c.index][0][0].gap_m)
        bridge, map_S_metric = ways[best.index][0]
        placed.append(Placed(best, map_S_metric @ best.metric_S_sfm, bridge))
        waiting.remove(best)
    untied = []
    for c in waiting:
        if not ways[c.index]:
            own = ", ".join(sorted({s.session_id for s in c.segments}))
            untied.append(Untied(c, None, f"no view and no walk ties it to the map: {own}"))
            continue
        gap_m = ways[c.index][0][0].gap_m
        contradiction = _contradiction(ways[c.index], longest_m, drift)
        found = contradiction if gap_m <= longest_m and contradiction else f"VIO alone for {gap_m:.1f} m"
        untied.append(Untied(c, gap_m, f"no view ties it to the map: {found}"))
    return placed, untied


def bridge_covariance(map_xyz: Array, bridge: Bridge) -> Array:
    """Covariances (N, 6, 6) at positions (N, 3) from the bridge that holds them: heading and position."""
    arm = np.asarray(map_xyz, dtype=float) - bridge.anchor
    jacobian = np.zeros((len(arm), 6, 4))
    jacobian[:, 1, 0] = 1.0
    jacobian[:, 3:, 0] = np.cross([0.0, 1.0, 0.0], arm)
    jacobian[:, 3:, 1:] = np.eye(3)
    variance = np.array([bridge.heading_sd, *[bridge.position_sd_m] * 3]) ** 2
    return np.einsum("nij,j,nkj->nik", jacobian, variance, jacobian)


def _ways(
    placed: Placed, component: Component, used: np.ndarray, window_m: float, sd: PoseSd, drift: BridgeSd
) -> list[tuple[Bridge, Sim3]]:
    """Each part of a session that leads from a placed component to another: the bridge, and map_S_metric of the other
    by it."""
    # Drift bends the path within a window more than it turns the camera: rotations tell the heading.
    bending = PoseSd(drift.position_m * np.sqrt(window_m), drift.heading * np.sqrt(window_m))
    found = []
    for a in placed.component.pieces if placed.component.scale.is_known else []:
        for b in component.pieces:
            if (a.session_id, a.index) != (b.session_id, b.index):
                continue
            here, there = a.where(a.both & used[a.rows]), b.where(b.both & used[b.rows])
            if min(len(here.rows), len(there.rows)) < _LEAST_FRAMES:
                continue
            along_a, along_b = _along(here, there)
            nearest = np.unravel_index(np.argmin(np.abs(along_a[:, None] - along_b)), (len(along_a), len(along_b)))
            gap_m = float(abs(along_a[nearest[0]] - along_b[nearest[1]]))
            middle = (along_a[nearest[0]] + along_b[nearest[1]]) / 2
            near_a, near_b = (_near(along, middle, (window_m + gap_m) / 2) for along in (along_a, along_b))
            map_T_cam = placed.map_S_sfm.poses(here.sfm_T_cam[near_a])
            metric_T_cam = component.metric_S_sfm.poses(there.sfm_T_cam[near_b])
            map_T_vio, _, _ = fit_rigid(map_T_cam, here.vio_T_cam[near_a], bending, yaw_only=True)
            metric_T_vio, _, _ = fit_rigid(metric_T_cam, there.vio_T_cam[near_b], bending, yaw_only=True)
            map_T_metric = map_T_vio @ inverse(metric_T_vio)
            path_m = float(abs(along_a[near_a].mean() - along_b[near_b].mean()))
            bridge = Bridge(
                a.session_id,
                gap_m,
                path_m,
                transform(map_T_vio, there.vio_T_cam[near_b, :3, 3]).mean(axis=0),
                float(np.hypot(sd.position_m, drift.position_m * np.sqrt(path_m))),
                float(drift.heading * np.sqrt(path_m)),
            )
            found.append((bridge, Sim3(1.0, map_T_metric[:3, :3], map_T_metric[:3, 3])))
    return found


def _contradiction(ways: list[tuple[Bridge, Sim3]], longest_m: float, drift: VioDrift) -> str | None:
    """How another way than the first, not longer than `longest_m`, disagrees with it, if one does."""
    bridge, map_S_metric = ways[0]
    anchor = map_S_metric.inverse().points(bridge.anchor)
    for other, other_S_metric in ways[1:]:
        if other.gap_m > longest_m:
            continue
        limit_m, limit_rad = (float(law(bridge.path_m + other.path_m)) for law in (drift.metres, drift.radians))
        turned = abs(float(heading(other_S_metric.rotation @ map_S_metric.rotation.T)))
        shifted = float(np.linalg.norm(other_S_metric.points(anchor) - bridge.anchor))
        arm = float(np.linalg.norm(bridge.anchor - other.anchor))
        if turned > limit_rad or shifted > limit_m + arm * limit_rad:
            return (
                f"{bridge.session_id} and {other.session_id} put it {shifted:.2f} m and {np.degrees(turned):.1f} "
                "degrees apart"
            )
    return None


def _along(a: Segment, b: Segment) -> tuple[Array, Array]:
    """How far along the VIO path through the frames of both each frame lies, in metres."""
    t_ns = np.concatenate([a.t_ns, b.t_ns])
    xyz = np.concatenate([a.vio_T_cam, b.vio_T_cam])[:, :3, 3]
    order = np.argsort(t_ns, kind="stable")
    along = np.empty(len(t_ns))
    along[order] = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz[order], axis=0), axis=1))])
    return along[: len(a.rows)], along[len(a.rows) :]


def _near(along: Array, middle: float, reach_m: float) -> np.ndarray:
    """Indices of the frames within reach of a place on the path; at least the nearest few."""
    distance = np.abs(along - middle)
    near = np.flatnonzero(distance <= reach_m)
    return near if len(near) >= _LEAST_FRAMES else np.argsort(distance, kind="stable")[:_LEAST_FRAMES]


def _origin(segments: list[Segment], metric_S_sfm: Sim3, used: np.ndarray, sd: PoseSd) -> Sim3:
    """Origin and heading: those of the VIO frame of the first segment that has 3 or more frames to tell by; where none
    has, the place of the first frame, with the heading as it comes."""
    for segment in segments:
        known = segment.both & used[segment.rows]
        if known.sum() >= _LEAST_FRAMES:
            metric_T_cam = metric_S_sfm.poses(segment.sfm_T_cam[known])
            metric_T_vio, _, _ = fit_rigid(metric_T_cam, segment.vio_T_cam[known], sd, yaw_only=True)
            vio_T_metric = inverse(metric_T_vio)
            return Sim3(1.0, vio_T_metric[:3, :3], vio_T_metric[:3, 3])
    first = next(s.where(s.registered & used[s.rows]) for s in segments if np.any(s.registered & used[s.rows]))
    return Sim3(1.0, np.eye(3), -metric_S_sfm.poses(first.sfm_T_cam[:1])[0, :3, 3])
