"""checks.png: SfM's path against VIO's or a reference's after alignment, frames without ground truth marked, and how
far they are apart."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.check_models import CheckedMap
from groundwalk.alignment.checks.results import describe, main_failure
from groundwalk.alignment.components import Component
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.segments import Segment, SegmentWindow
from groundwalk.consistency.windows import POSE_SD, fit_rigid
from groundwalk.geometry.poses import Array, transform
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.store.registry import Colour

_MAX_SESSIONS = 8
_INCHES = 3.2
_REASON_WIDTH = 75


def draw_checks(path: Path, checked: CheckedMap, reference: Reference | None, title: str, *, simulated: bool) -> None:
    """One row a session, those with most excluded frames first: plan of both paths, residual curves with limits.

    VIO is fitted to SfM over the whole session, rigidly and robustly; the curves are the windows' residuals. Where a
    reference gives the map, SfM's model is fitted to that as a whole, and the plan is what shows most of the path. Of
    images alone there is nothing to draw, and no file.
    """
    by_reference = reference if checked.reference_limit is not None else None
    segments = [
        (component, segment)
        for component in checked.components
        for segment in component.segments
        if (segment.has_both if by_reference is None else segment.registered).any()
    ]
    segments.sort(key=lambda pair: (-np.mean(checked.frames.exclusion[pair[1].rows] != ""), pair[1].session_id))
    drawn = segments[:_MAX_SESSIONS]
    if not drawn:
        return
    figure = Figure(figsize=(4 * _INCHES, _INCHES * len(drawn) + 0.6), layout="constrained")
    axes = figure.subplots(len(drawn), 3, squeeze=False, width_ratios=[1.3, 1, 1])
    for (plan, metres, degrees), (component, segment) in zip(axes, drawn, strict=False):
        if by_reference is not None:
            _draw_against_reference((plan, metres, degrees), checked, by_reference, component, segment)
            continue
        _draw_plan(plan, checked, component, segment)
        first, last = segment.t_ns[0], segment.t_ns[-1]
        windows = [
            w
            for w in checked.windows
            if (w.segment.session_id, w.segment.component) == (segment.session_id, segment.component)
            and first <= w.segment.t_ns[w.inside[0]] <= last
        ]
        limits = [(w, w.position_m, w.limit_m) for w in windows]
        _draw_curves(metres, limits, segment, "m")
        limits = [(w, np.degrees(w.rotation), float(np.degrees(w.limit_rotation))) for w in windows]
        _draw_curves(degrees, limits, segment, "deg")
    summary, main = describe(checked.checks)[0], main_failure(checked.checks)
    if main is not None:
        session = f", {main.subject.session_id}" if main.subject.session_id else ""
        summary = f"{main.cause}{session}: {main.reason}"
    kind = " (simulated)" if simulated else ""
    more = f"; {len(segments) - len(drawn)} more without a plot" if len(segments) > len(drawn) else ""
    figure.suptitle(f"{title}{kind}: {summary}{more}", fontsize=10, wrap=True)
    figure.savefig(path, dpi=100)


def _draw_against_reference(
    axes: tuple[Axes, Axes, Axes], checked: CheckedMap, reference: Reference, component: Component, segment: Segment
) -> None:
    """Both paths in the two directions in which the reference extends most, and each frame's residuals in order."""
    segment = segment.where(segment.registered)
    rows, stated = segment.rows, reference.map_T_cam[segment.rows, :3, 3]
    (placed,) = (p for p in checked.placed if p.component.index == component.index)
    sfm = placed.map_S_sfm.poses(segment.sfm_T_cam)[:, :3, 3]
    known = stated[np.isfinite(stated[:, 0])]
    middle = known.mean(axis=0) if len(known) else np.zeros(3)
    directions = np.linalg.svd(known - middle)[2][:2] if len(known) else np.eye(3)[:2]
    sfm, stated = (sfm - middle) @ directions.T, (stated - middle) @ directions.T
    is_excluded = checked.frames.exclusion[rows] != ""
    unit = "m" if reference.is_metric else "the reference's unit"
    plan, *curves = axes
    plan.plot(*stated.T, color=_rgb(VIO), lw=1.2, marker=".", ms=3, label="reference")
    plan.plot(*sfm.T, color=_rgb(GROUND_TRUTH), lw=1.2, marker=".", ms=3, label="SfM")
    plan.plot(*sfm[is_excluded].T, "x", ms=5, color=_rgb(REJECTED), label=f"no ground truth: {is_excluded.sum()}")
    _finish_plan(plan, f"{segment.session_id}, model {segment.component}: widest plane, {unit}")
    assert checked.reference_limit is not None
    limit, limit_rad = checked.reference_limit
    degrees = np.degrees(checked.frames.residual_rad[rows])
    residuals = (checked.frames.residual_m[rows], limit, unit), (degrees, float(np.degrees(limit_rad)), "deg")
    for axis, (values, most, name) in zip(curves, residuals, strict=True):
        axis.plot(values, color=_rgb(GROUND_TRUTH), lw=1)
        axis.plot(np.flatnonzero(values > most), values[values > most], "x", ms=4, color=_rgb(REJECTED))
        axis.axhline(most, color=_rgb(NEUTRAL), lw=1, ls="--")
        _finish_curve(axis, f"SfM from the reference, {name} (dashed: limit)", "frames in order")


def _draw_plan(plan: Axes, checked: CheckedMap, component: Component, segment: Segment) -> None:
    both = segment.where(segment.has_both)
    metric_T_cam = component.metric_S_sfm.poses(both.sfm_T_cam)
    metric_T_vio, _, _ = fit_rigid(metric_T_cam, both.vio_T_cam, POSE_SD)
    sfm, vio = metric_T_cam[:, :3, 3], transform(metric_T_vio, both.vio_T_cam[:, :3, 3])
    is_excluded = checked.frames.exclusion[both.rows] != ""
    x, z = sfm[is_excluded, 0], sfm[is_excluded, 2]
    plan.plot(vio[:, 0], vio[:, 2], color=_rgb(VIO), lw=1.2, label="VIO")
    plan.plot(sfm[:, 0], sfm[:, 2], color=_rgb(GROUND_TRUTH), lw=1.2, label="SfM")
    plan.plot(x, z, "x", ms=5, color=_rgb(REJECTED), label=f"no ground truth: {is_excluded.sum()}")
    plan.invert_yaxis()
    name = segment.session_id + (f", part {segment.index}" if segment.index else "")
    reasons = Counter(checked.frames.exclusion[both.rows[is_excluded]]).most_common(1)
    lines = [textwrap.fill(reason, _REASON_WIDTH) for reason, _ in reasons]
    _finish_plan(plan, "\n".join([f"{name}, model {segment.component}: plan, m", *lines]))


def _finish_plan(plan: Axes, title: str) -> None:
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_title(title, fontsize=8)
    plan.legend(fontsize=7)
    plan.tick_params(labelsize=7)


def _draw_curves(axis: Axes, curves: Sequence[tuple[SegmentWindow, Array, float]], segment: Segment, unit: str) -> None:
    """The residuals of each window over time, with its limit, drawn over its length."""
    for window, values, limit in curves:
        seconds = (window.segment.t_ns[window.inside] - segment.t_ns[0]) * 1e-9
        is_beyond = values > limit
        axis.plot(seconds, values, color=_rgb(REJECTED if is_beyond.any() else GROUND_TRUTH), lw=1)
        axis.plot(seconds[is_beyond], values[is_beyond], "x", ms=4, color=_rgb(REJECTED))
        axis.plot(seconds[[0, -1]], [limit, limit], color=_rgb(NEUTRAL), lw=1, ls="--")
    _finish_curve(axis, f"SfM from VIO in windows, {unit} (dashed: limit)", "s")


def _finish_curve(axis: Axes, title: str, along: str) -> None:
    axis.set_ylim(bottom=0)
    axis.set_title(title, fontsize=8)
    axis.set_xlabel(along, fontsize=7)
    axis.tick_params(labelsize=7)


def _rgb(colour: Colour) -> tuple[float, float, float]:
    r, g, b = (value / 255 for value in colour)
    return r, g, b
