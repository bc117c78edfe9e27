"""Do SfM and VIO tell the same story, window by window? Where they don't, the model is wrong or VIO jumped."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundwalk.alignment.checks import DISAGREES, About, Check, check
from groundwalk.alignment.components import Component
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import SIGMAS, beyond, within
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.consistency.windows import PoseSd, WindowResiduals, compare_windows
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array


@dataclass(frozen=True)
class Window(WindowResiduals):
    """A window of a segment: `inside` (n,) are indices of its frames."""

    segment: Segment


def compare(
    segment: Segment,
    metric_S_sfm: Sim3,
    window_m: float,
    drift: VioDrift,
    sd: PoseSd,
    frame_sd: tuple[Array, Array] | None = None,
) -> list[Window]:
    """The windows of a segment, each with VIO rigidly fitted to SfM at the common metric scale; `frame_sd`: standard
    errors of its frames in SfM, metres and radians (N,), NaN where not known."""
    known, pair = np.flatnonzero(segment.both), segment.trajectory_pair
    of_known = None if frame_sd is None else (np.nan_to_num(frame_sd[0][known]), np.nan_to_num(frame_sd[1][known]))
    found = compare_windows(metric_S_sfm.poses(pair.sfm_T_cam), pair.vio_T_cam, window_m, drift, sd, frame_sd=of_known)
    return [Window(**{**vars(w), "inside": known[w.inside]}, segment=segment) for w in found]


def compare_component(
    component: Component, settings: AlignSettings, drift: VioDrift, sd: PoseSd, frame_sd: tuple[Array, Array]
) -> list[Window]:
    """The windows of a metric model; `frame_sd` as in `compare`, over the rows of the frames table."""
    if not component.scale.is_known:
        return []
    return [
        window
        for piece in component.pieces
        for window in compare(
            piece,
            component.metric_S_sfm,
            settings.window_m,
            drift,
            sd,
            (frame_sd[0][piece.rows], frame_sd[1][piece.rows]),
        )
    ]


def check_window(window: Window) -> list[Check]:
    """Both checks of a window: its largest residuals against what VIO may drift by there."""
    rows, times = window.segment.rows[window.inside], window.segment.t_ns[window.inside]
    about = About(len(rows), window.segment.session_id, window.segment.component, times)
    reason = f"{int(window.wrong.sum())} of {len(rows)} frames move otherwise in SfM than in VIO"
    checks = []
    for name, values, sds, limit, unit in (
        ("window_position", window.position_m, window.position_sd_m, window.limit_m, 1.0),
        ("window_rotation", window.rotation, window.rotation_sd, window.limit_rotation, float(np.degrees(1.0))),
    ):
        wrong, right = beyond(values, sds, limit), within(values, sds, limit)
        # The frame that decides: surely wrong, else perhaps.
        margin = SIGMAS * sds * (-1.0 if wrong.any() else 1.0)
        worst = int(np.argmax(values + margin))
        result = check(
            name,
            unit * float(values[worst]),
            unit * float(sds[worst]),
            unit * limit,
            about,
            DISAGREES,
            reason,
        )
        frame_reason = "SfM and VIO disagree here"
        checks.append(replace(result, refused=rows[wrong], doubtful=rows[~wrong & ~right], frame_reason=frame_reason))
    return checks


def worst_by_frame(count: int, compared: Sequence[Window]) -> tuple[Array, Array]:
    """The largest residual over its windows of each row of the frames table, metres and radians (count,), NaN where it
    is in none."""
    metres, radians = np.full(count, np.nan), np.full(count, np.nan)
    for window in compared:
        rows = window.segment.rows[window.inside]
        metres[rows] = np.fmax(metres[rows], window.position_m)
        radians[rows] = np.fmax(radians[rows], window.rotation)
    return metres, radians
