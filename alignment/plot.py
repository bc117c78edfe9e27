"""checks.png: SfM's path against VIO's after alignment, frames without ground truth marked, and their distance."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.checks.results import main_failure
from groundwalk.alignment.checks.summary import describe
from groundwalk.alignment.checks.windows import SegmentWindow
from groundwalk.alignment.components import Component
from groundwalk.alignment.examination import Examination
from groundwalk.alignment.segments import Segment
from groundwalk.artefacts.recording import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.consistency.windows import PoseSd, fit_rigid
from groundwalk.geometry.poses import Array, transform

_MAX_SESSIONS = 8
_INCHES = 3.2
_REASON_WIDTH = 75


def draw_checks(path: Path, examination: Examination, title: str, *, simulated: bool) -> None:
    """One row a session, those with most excluded frames first: plan of both paths, residual curves with limits.

    VIO is fitted to SfM over the whole session, rigidly and robustly; the curves are the windows' residuals.
    """
    parts = [(c, s) for c in examination.components for s in c.segments if s.has_both.any()]
    parts.sort(key=lambda part: (-np.mean(examination.exclusion[part[1].rows] != ""), part[1].session_id))
    drawn = parts[:_MAX_SESSIONS]
    figure = Figure(figsize=(4 * _INCHES, _INCHES * max(len(drawn), 1) + 0.6), layout="constrained")
    axes = figure.subplots(max(len(drawn), 1), 3, squeeze=False, width_ratios=[1.3, 1, 1])
    for (plan, metres, degrees), (component, segment) in zip(axes, drawn, strict=False):
        _draw_plan(plan, examination, component, segment)
        windows = [w for w in examination.windows if _is_within(w, segment)]
        limits = [(w, w.position_m, w.limit_m) for w in windows]
        _draw_curves(metres, limits, segment, "m")
        limits = [(w, np.degrees(w.rotation), float(np.degrees(w.limit_rotation))) for w in windows]
        _draw_curves(degrees, limits, segment, "deg")
    summary, main = describe(examination.checks)[0], main_failure(examination.checks)
    if main is not None:
        session = f", {main.subject.session_id}" if main.subject.session_id else ""
        summary = f"{main.cause}{session}: {main.reason}"
    kind = " (simulated)" if simulated else ""
    more = f"; {len(parts) - len(drawn)} more without a plot" if len(parts) > len(drawn) else ""
    figure.suptitle(f"{title}{kind}: {summary}{more}", fontsize=10, wrap=True)
    figure.savefig(path, dpi=100)


def _draw_plan(plan: Axes, examination: Examination, component: Component, segment: Segment) -> None:
    both = segment.where(segment.has_both)
    metric_T_cam = component.metric_S_sfm.poses(both.sfm_T_cam)
    metric_T_vio, _, _ = fit_rigid(metric_T_cam, both.vio_T_cam, PoseSd(0.05, 0.02))
    sfm, vio = metric_T_cam[:, :3, 3], transform(metric_T_vio, both.vio_T_cam[:, :3, 3])
    is_excluded = examination.exclusion[both.rows] != ""
    x, z = sfm[is_excluded, 0], sfm[is_excluded, 2]
    plan.plot(vio[:, 0], vio[:, 2], color=_rgb(VIO), lw=1.2, label="VIO")
    plan.plot(sfm[:, 0], sfm[:, 2], color=_rgb(GROUND_TRUTH), lw=1.2, label="SfM")
    plan.plot(x, z, "x", ms=5, color=_rgb(REJECTED), label=f"no ground truth: {is_excluded.sum()}")
    plan.set_aspect("equal", adjustable="datalim")
    plan.invert_yaxis()
    name = segment.session_id + (f", part {segment.index}" if segment.index else "")
    reasons = Counter(examination.exclusion[both.rows[is_excluded]]).most_common(1)
    lines = [textwrap.fill(reason, _REASON_WIDTH) for reason, _ in reasons]
    plan.set_title("\n".join([f"{name}, model {segment.component}: plan, m", *lines]), fontsize=8)
    plan.legend(fontsize=7)
    plan.tick_params(labelsize=7)


def _is_within(window: SegmentWindow, segment: Segment) -> bool:
    piece = window.segment
    is_same = (piece.session_id, piece.component) == (segment.session_id, segment.component)
    return is_same and segment.t_ns[0] <= piece.t_ns[window.inside[0]] <= segment.t_ns[-1]


def _draw_curves(axis: Axes, curves: Sequence[tuple[SegmentWindow, Array, float]], segment: Segment, unit: str) -> None:
    """The residuals of each window over time, with its limit, drawn over its length."""
    for window, values, limit in curves:
        seconds = (window.segment.t_ns[window.inside] - segment.t_ns[0]) * 1e-9
        is_beyond = values > limit
        axis.plot(seconds, values, color=_rgb(REJECTED if is_beyond.any() else GROUND_TRUTH), lw=1)
        axis.plot(seconds[is_beyond], values[is_beyond], "x", ms=4, color=_rgb(REJECTED))
        axis.plot(seconds[[0, -1]], [limit, limit], color=_rgb(NEUTRAL), lw=1, ls="--")
    axis.set_ylim(bottom=0)
    axis.set_title(f"SfM from VIO in windows, {unit} (dashed: limit)", fontsize=8)
    axis.set_xlabel("s", fontsize=7)
    axis.tick_params(labelsize=7)


def _rgb(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    r, g, b = (value / 255 for value in colour)
    return r, g, b
