"""Where the focal length of a session's images steps although its log says nothing: digital zoom, or another lens."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.geometry.robust import SIGMA_OF_MEDIAN

# A step is judged by so many frames, at most and at least, before and after it.
_FRAMES, _MIN_FRAMES = 5, 3
# It is one where it exceeds the scatter of these frames so many times; a drift, as of focus, doesn't.
_MIN_SCATTERS = 8.0
# The scatter of estimates that happen to be nearly the same.
_MIN_SCATTER = 0.002


@dataclass(frozen=True)
class FocalStep:
    """The first frame after a step, and the factor of focal lengths there."""

    first: int
    factor: float


def with_focal_steps(
    intrinsics: pd.DataFrame, frames: pd.DataFrame, images: pd.DataFrame, limit: float
) -> pd.DataFrame:
    """Table sfm.intrinsics with the step of each session's focal lengths in each model, from import's frames and the
    rows of sfm.images in the same order. Steps up to the fraction `limit` aren't named."""
    adjusted = frames[["frame_id", "session_id", "t_ns"]].assign(
        model_id=images["model_id"].to_numpy(object), scale=images["fx"].to_numpy(float) / frames["fx"].to_numpy(float)
    )
    adjusted = adjusted.sort_values("t_ns", kind="stable")
    factors, first_ids = [], []
    for row in intrinsics.itertuples(index=False):
        of_row = adjusted[(adjusted["model_id"] == row.model_id) & (adjusted["session_id"] == row.session_id)]
        step = focal_step(of_row["scale"].to_numpy(float), limit)
        factors.append(None if step is None else step.factor)
        first_ids.append(None if step is None else of_row["frame_id"].iloc[step.first])
    return intrinsics.assign(
        focal_step=pd.Series(factors, dtype=float), focal_step_frame_id=pd.Series(first_ids, dtype=object)
    )


def focal_step(focal_scale_N: Array, limit: float) -> FocalStep | None:
    """The largest step in N frames' factors from logged focal lengths to adjusted ones, in the order of time, that is
    larger than the fraction `limit`. None where there is no such step."""
    log_scale = np.log(focal_scale_N)
    to_next = np.abs(np.diff(log_scale))
    steps = []
    for first in range(_MIN_FRAMES, len(log_scale) - _MIN_FRAMES + 1):
        sides = (log_scale[max(first - _FRAMES, 0) : first], log_scale[first : first + _FRAMES])
        before, after = (float(np.median(side)) for side in sides)
        scatter = SIGMA_OF_MEDIAN * np.median(np.abs(np.concatenate([sides[0] - before, sides[1] - after])))
        if abs(after - before) > max(_MIN_SCATTERS * max(float(scatter), _MIN_SCATTER), np.log1p(limit)):
            steps.append(FocalStep(first, float(np.exp(after - before))))
    # Splits beside the step look like it, too: it's between the two frames that differ most.
    return max(steps, key=lambda step: to_next[step.first - 1], default=None)
