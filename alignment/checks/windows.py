"""Do SfM and VIO agree window by window? Where they don't, the model is wrong or VIO jumped."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import Component
from groundwalk.alignment.segments import SegmentWindow
from groundwalk.consistency.decisions import SIGMAS, beyond, within
from groundwalk.consistency.windows import compare_windows
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import CheckName, FailureCause

_REASON = "pose in SfM inconsistent with VIO"


def component_windows(component: Component, frame_sd: tuple[Array, Array]) -> list[SegmentWindow]:
    """The windows of a metric model, each with VIO rigidly fitted to SfM at the common scale; `frame_sd`: standard
    errors of poses in SfM over the rows of the frames table, metres and radians, NaN where unknown."""
    windows: list[SegmentWindow] = []
    for segment in component.segments if component.scale.is_known else []:
        compared, pair = np.flatnonzero(segment.has_both), segment.trajectory_pair
        metric = pair._replace(sfm_T_cam=component.metric_S_sfm.poses(pair.sfm_T_cam))
        sd_m, sd_rad = (np.nan_to_num(sd[segment.rows[compared]]) for sd in frame_sd)
        found = compare_windows(metric, frame_sd=(sd_m, sd_rad))
        windows += [SegmentWindow(**{**vars(w), "inside": compared[w.inside]}, segment=segment) for w in found]
    return windows


def check_window(window: SegmentWindow) -> list[CheckResult]:
    """Both checks of a window: its largest residuals against what VIO may drift by over its path."""
    degrees = float(np.degrees(1.0))
    return [
        _check_residuals(CheckName.WINDOW_POSITION, window, window.position_m, window.position_sd_m, window.limit_m),
        _check_residuals(
            CheckName.WINDOW_ROTATION, window, window.rotation, window.rotation_sd, window.limit_rotation, degrees
        ),
    ]


def _check_residuals(
    name: CheckName, window: SegmentWindow, residuals: Array, sds: Array, limit: float, unit: float = 1.0
) -> CheckResult:
    rows, t_ns = window.segment.rows[window.inside], window.segment.t_ns[window.inside]
    wrong, right = beyond(residuals, sds, limit), within(residuals, sds, limit)
    # The frame that decides: beyond the limit for certain, else the one that may be furthest.
    worst = int(np.argmax(residuals + SIGMAS * sds * (-1.0 if wrong.any() else 1.0)))
    result = evaluate(
        name,
        Subject(len(rows), window.segment.session_id, window.segment.component, t_ns),
        Quantity(unit * float(residuals[worst]), unit * float(sds[worst])),
        unit * limit,
        Failure(FailureCause.VIO_INCONSISTENT, f"{int(window.wrong.sum())} of {len(rows)} frames: {_REASON}"),
    )
    return replace(result, exclusions=(Exclusion(rows[wrong], _REASON),), undecided_rows=rows[~wrong & ~right])


def max_residuals(count: int, windows: Sequence[SegmentWindow]) -> tuple[Array, Array]:
    """The largest residual over its windows of each row of the frames table, metres and radians (count,), NaN where it
    is in none."""
    metres, radians = np.full(count, np.nan), np.full(count, np.nan)
    for window in windows:
        rows = window.segment.rows[window.inside]
        metres[rows] = np.fmax(metres[rows], window.position_m)
        radians[rows] = np.fmax(radians[rows], window.rotation)
    return metres, radians
