"""gate.png: SfM's path against VIO's after alignment, the frames without ground truth marked, and how they part."""

import textwrap
from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.checks import describe, main_failure
from groundwalk.alignment.components import Component
from groundwalk.alignment.examination import Examination
from groundwalk.alignment.segments import Segment
from groundwalk.artefacts.recording import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.consistency.windows import PoseSd, fit_rigid
from groundwalk.geometry.poses import transform

_MOST_SESSIONS = 8
_INCHES = 3.2
_REASON_WIDTH = 75


def draw_gate(path: Path, found: Examination, title: str, *, simulated: bool) -> None:
    """One row a session, those with most refused frames first: plan of both paths, residual curves with limits.

    VIO is fitted to SfM over the whole session, rigidly and robustly; the curves are the windows' residuals.
    """
    parts = [(c, s) for c in found.components for s in c.segments if s.both.any()]
    parts.sort(key=lambda part: (-np.mean(found.reason[part[1].rows] != ""), part[1].session_id))
    shown = parts[:_MOST_SESSIONS]
    figure = Figure(figsize=(4 * _INCHES, _INCHES * max(len(shown), 1) + 0.6), layout="constrained")
    axes = figure.subplots(max(len(shown), 1), 3, squeeze=False, width_ratios=[1.3, 1, 1])
    for (plan, metres, degrees), (component, segment) in zip(axes, shown, strict=False):
        _draw_plan(plan, found, component, segment)
        _draw_curves(metres, degrees, found, segment)
    main = main_failure(found.checks)
    verdict = describe(found.checks)[0]
    if main is not None:
        session = f", {main.about.session_id}" if main.about.session_id else ""
        verdict = f"{main.cause}{session}: {main.reason}"
    kind = " (simulated)" if simulated else ""
    left_out = f"; {len(parts) - len(shown)} more not shown" if len(parts) > len(shown) else ""
    figure.suptitle(f"{title}{kind}: {verdict}{left_out}", fontsize=10, wrap=True)
    figure.savefig(path, dpi=100)


def _draw_plan(plan: Axes, found: Examination, component: Component, segment: Segment) -> None:
    known = segment.where(segment.both)
    metric_T_cam = component.metric_S_sfm.poses(known.sfm_T_cam)
    metric_T_vio, _, _ = fit_rigid(metric_T_cam, known.vio_T_cam, PoseSd(0.05, 0.02))
    sfm, vio = metric_T_cam[:, :3, 3], transform(metric_T_vio, known.vio_T_cam[:, :3, 3])
    refused = found.reason[known.rows] != ""
    plan.plot(vio[:, 0], vio[:, 2], color=_rgb(VIO), lw=1.2, label="VIO")
    plan.plot(sfm[:, 0], sfm[:, 2], color=_rgb(GROUND_TRUTH), lw=1.2, label="SfM")
    plan.plot(
        sfm[refused, 0], sfm[refused, 2], "x", ms=5, color=_rgb(REJECTED), label=f"no ground truth: {refused.sum()}"
    )
    plan.set_aspect("equal", adjustable="datalim")
    plan.invert_yaxis()
    name = segment.session_id + (f", part {segment.index}" if segment.index else "")
    reasons = Counter(found.reason[known.rows[refused]]).most_common(1)
    told = [textwrap.fill(reason, _REASON_WIDTH) for reason, _ in reasons]
    plan.set_title("\n".join([f"{name}, model {segment.component}: plan, m", *told]), fontsize=8)
    plan.legend(fontsize=7)
    plan.tick_params(labelsize=7)


def _draw_curves(metres: Axes, degrees: Axes, found: Examination, segment: Segment) -> None:
    """Each window is a curve of its own over the path; limits are drawn over its length."""
    start_ns = segment.t_ns[0]
    own = [
        w
        for w in found.windows
        if w.segment.session_id == segment.session_id and w.segment.component == segment.component
    ]
    for axis, unit in ((metres, "m"), (degrees, "deg")):
        for window in own:
            inside = window.inside
            if not segment.t_ns[0] <= window.segment.t_ns[inside[0]] <= segment.t_ns[-1]:
                continue
            seconds = (window.segment.t_ns[inside] - start_ns) * 1e-9
            values, limit = (
                (window.position_m, window.limit_m)
                if unit == "m"
                else (np.degrees(window.rotation), float(np.degrees(window.limit_rotation)))
            )
            bad = values > limit
            axis.plot(seconds, values, color=_rgb(REJECTED if bad.any() else GROUND_TRUTH), lw=1)
            axis.plot(seconds[bad], values[bad], "x", ms=4, color=_rgb(REJECTED))
            axis.plot(seconds[[0, -1]], [limit, limit], color=_rgb(NEUTRAL), lw=1, ls="--")
        axis.set_ylim(bottom=0)
        axis.set_title(f"SfM from VIO in windows, {unit} (dashed: limit)", fontsize=8)
        axis.set_xlabel("s", fontsize=7)
        axis.tick_params(labelsize=7)


def _rgb(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    r, g, b = (value / 255 for value in colour)
    return r, g, b
