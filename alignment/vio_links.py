"""All SfM models in one map: what no view ties to the first is linked to it by VIO over a short path."""

import numpy as np

from groundwalk.alignment.components import Component, PlacedComponent, Unlinked, VioLink
from groundwalk.alignment.segments import Segment
from groundwalk.consistency.vio_drift import drift_m, drift_rad
from groundwalk.consistency.windows import POSE_SD, WINDOW_M, PoseSd, fit_rigid
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, inverse, rotation_angle, transform

_MIN_FRAMES = 3
# VIO's drift (sd) over a metre, in position and heading; it grows with the square root of the path. What phones were
# measured to drift by (docs/explanation/vio-drift.md).
_DRIFT = PoseSd(0.03, float(np.radians(0.6)))


def place_components(
    components: list[Component], used: np.ndarray, max_link_m: float
) -> tuple[list[PlacedComponent], list[Unlinked]]:
    """Put components (largest first) into one map. `used` (N,): frames of the frames table to fit.

    The first component gives origin and heading. Each other one is linked by VIO alone, through a session that has
    frames in it and in the map, over the shortest path of at most `max_link_m`; half a window around it is fitted on
    both sides. Links through several sessions must agree within VIO's drift.
    """
    if not components:
        return [], []
    first = components[0]
    # Without a scale positions say nothing of the heading.
    sd = POSE_SD if first.scale.is_known else PoseSd(np.inf, POSE_SD.rotation)
    placed = [PlacedComponent(first, _origin(first, used, sd) @ first.metric_S_sfm)]
    waiting = list(components[1:])
    candidates: dict[int, list[PlacedComponent]] = {}
    objections: dict[int, str] = {}
    while waiting:
        candidates = {c.index: _candidates(placed, c, used) for c in waiting}
        objections = {c.index: _objection(c, candidates[c.index], max_link_m) for c in waiting}
        near = [c for c in waiting if not objections[c.index]]
        if not near:
            break
        nearest = min(near, key=lambda c: candidates[c.index][0].links[-1].gap_m)
        placed.append(candidates[nearest.index][0])
        waiting.remove(nearest)
    gaps_m = {index: found[0].links[-1].gap_m if found else None for index, found in candidates.items()}
    return placed, [(c, gaps_m[c.index], objections[c.index]) for c in waiting]


def _candidates(placed: list[PlacedComponent], component: Component, used: np.ndarray) -> list[PlacedComponent]:
    """Where a component lies by links to those in the map, through sessions that go from one to the other without a VIO
    jump; by the shortest link first."""
    candidates = [
        _candidate(each, component, *(s.where(s.has_both & used[s.rows]) for s in (a, b)))
        for each in placed
        for a in (each.component.segments if each.component.scale.is_known else [])
        for b in component.segments
        if (a.session_id, a.index) == (b.session_id, b.index)
    ]
    return sorted((c for c in candidates if c is not None), key=lambda candidate: candidate.links[-1].gap_m)


def _candidate(placed: PlacedComponent, component: Component, a: Segment, b: Segment) -> PlacedComponent | None:
    """By the link through the frames `a` of a placed component and `b` of another; None where they are too few."""
    if min(len(a.rows), len(b.rows)) < _MIN_FRAMES:
        return None
    window_m = WINDOW_M / 2
    # Drift bends the path within a window more than it turns the camera: rotations determine the heading.
    bending = PoseSd(_DRIFT.position_m * np.sqrt(window_m), _DRIFT.rotation * np.sqrt(window_m))
    along_a, along_b = a.travelled_m, b.travelled_m
    nearest = np.unravel_index(np.argmin(np.abs(along_a[:, None] - along_b)), (len(along_a), len(along_b)))
    gap_m = float(abs(along_a[nearest[0]] - along_b[nearest[1]]))
    middle = (along_a[nearest[0]] + along_b[nearest[1]]) / 2
    near_a, near_b = (_near(along, middle, (window_m + gap_m) / 2) for along in (along_a, along_b))
    map_T_cam = placed.map_S_sfm.poses(a.sfm_T_cam[near_a])
    metric_T_cam = component.metric_S_sfm.poses(b.sfm_T_cam[near_b])
    # Yaw alone where both models are upright and so is VIO; else VIO's vertical, whatever it is, joins them.
    yaw_only = all(c.vertical.source.is_known for c in (placed.component, component)) and a.has_gravity
    map_T_vio, _, _ = fit_rigid(map_T_cam, a.vio_T_cam[near_a], bending, yaw_only=yaw_only)
    metric_T_vio, _, _ = fit_rigid(metric_T_cam, b.vio_T_cam[near_b], bending, yaw_only=yaw_only)
    map_T_metric = map_T_vio @ inverse(metric_T_vio)
    path_m = float(abs(along_a[near_a].mean() - along_b[near_b].mean()))
    anchor = transform(map_T_vio, b.vio_T_cam[near_b, :3, 3]).mean(axis=0)
    sd_m = float(np.hypot(POSE_SD.position_m, _DRIFT.position_m * np.sqrt(path_m)))
    link = VioLink(a.session_id, gap_m, path_m, anchor, sd_m, float(_DRIFT.rotation * np.sqrt(path_m)))
    map_S_metric = Sim3(1.0, map_T_metric[:3, :3], map_T_metric[:3, 3])
    return PlacedComponent(component, map_S_metric @ component.metric_S_sfm, (*placed.links, link))


def _objection(component: Component, candidates: list[PlacedComponent], max_link_m: float) -> str:
    """Why a component can't be linked: no link, one that is too long, or another that isn't and puts it elsewhere than
    the first one does; empty where it can."""
    if not candidates:
        sessions = ", ".join(sorted({s.session_id for s in component.segments}))
        return f"no view and no VIO path links {sessions} to the map"
    link, map_S_sfm = candidates[0].links[-1], candidates[0].map_S_sfm
    if link.gap_m > max_link_m:
        return f"no view links it to the map; VIO path without a registered frame {link.gap_m:.1f} m"
    anchor = map_S_sfm.inverse().points(link.anchor)
    for candidate in candidates[1:]:
        other, other_S_sfm = candidate.links[-1], candidate.map_S_sfm
        if other.gap_m > max_link_m:
            continue
        path_m = link.path_m + other.path_m
        limit_m, limit_rad = float(drift_m(path_m)), float(drift_rad(path_m))
        turn = float(rotation_angle(other_S_sfm.rotation @ map_S_sfm.rotation.T))
        shift_m = float(np.linalg.norm(other_S_sfm.points(anchor) - link.anchor))
        arm_m = float(np.linalg.norm(link.anchor - other.anchor))
        if turn > limit_rad or shift_m > limit_m + arm_m * limit_rad:
            return (
                f"VIO links contradict each other: {link.session_id} and {other.session_id} put it {shift_m:.2f} m and "
                f"{np.degrees(turn):.1f} degrees apart"
            )
    return ""


def _near(along: Array, middle: float, reach_m: float) -> np.ndarray:
    """Indices of the frames within reach of a place on the path; at least the nearest few."""
    distance = np.abs(along - middle)
    near = np.flatnonzero(distance <= reach_m)
    return near if len(near) >= _MIN_FRAMES else np.argsort(distance, kind="stable")[:_MIN_FRAMES]


def _origin(first: Component, used: np.ndarray, sd: PoseSd) -> Sim3:
    """Origin and heading: those of the VIO frame of the first segment with three frames or more in both, and gravity;
    in a model without a vertical all its axes. Without one, the place of the first frame, with the heading as it
    comes."""
    segments, metric_S_sfm, is_upright = first.segments, first.metric_S_sfm, first.vertical.source.is_known
    for segment in segments:
        both = segment.has_both & used[segment.rows]
        if both.sum() >= _MIN_FRAMES and segment.has_gravity >= is_upright:
            metric_T_cam = metric_S_sfm.poses(segment.sfm_T_cam[both])
            metric_T_vio, _, _ = fit_rigid(metric_T_cam, segment.vio_T_cam[both], sd, yaw_only=is_upright)
            vio_T_metric = inverse(metric_T_vio)
            return Sim3(1.0, vio_T_metric[:3, :3], vio_T_metric[:3, 3])
    start = next(s.where(s.registered & used[s.rows]) for s in segments if np.any(s.registered & used[s.rows]))
    return Sim3(1.0, np.eye(3), -metric_S_sfm.poses(start.sfm_T_cam[:1])[0, :3, 3])
