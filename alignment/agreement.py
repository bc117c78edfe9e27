"""Do SfM and VIO tell the same story, window by window? Where they don't, the model is wrong or VIO jumped."""

from dataclasses import dataclass

import numpy as np

from alignment.segments import Segment
from geometry.fits import Sim3
from geometry.poses import Array
from geometry.vio_agreement import PoseSd, WindowResiduals, compare_windows
from geometry.vio_drift import VioDrift


@dataclass(frozen=True)
class Window(WindowResiduals):
    """A window of a segment: `inside` (n,) are indices of its frames."""

    segment: Segment


def compare(segment: Segment, metric_S_sfm: Sim3, window_m: float, drift: VioDrift, sd: PoseSd) -> list[Window]:
    """The windows of a segment, each with VIO rigidly fitted to SfM at the common metric scale."""
    known, stretch = np.flatnonzero(segment.both), segment.stretch
    found = compare_windows(metric_S_sfm.poses(stretch.sfm_T_cam), stretch.vio_T_cam, window_m, drift, sd)
    return [
        Window(known[w.inside], w.position_m, w.rotation, w.limit_m, w.limit_rotation, segment=segment) for w in found
    ]


def worst_by_frame(segment: Segment, compared: list[Window]) -> tuple[Array, Array, np.ndarray]:
    """Each frame's largest residual over its windows, metres and radians (N,), NaN where it is in none; and whether
    it is beyond a limit in any of them (N,)."""
    metres = np.full(len(segment.rows), np.nan)
    radians = np.full(len(segment.rows), np.nan)
    wrong = np.zeros(len(segment.rows), dtype=bool)
    for window in compared:
        metres[window.inside] = np.fmax(metres[window.inside], window.position_m)
        radians[window.inside] = np.fmax(radians[window.inside], window.rotation)
        wrong[window.inside] |= window.wrong
    return metres, radians, wrong
