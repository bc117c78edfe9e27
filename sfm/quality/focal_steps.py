"""Where the focal length of a session's images steps although its log says nothing: digital zoom, or another lens."""

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.geometry.robust import SIGMA_OF_MEDIAN

# Focal lengths that are off, or step, by a larger fraction are named. Whether they fail is align's to say.
MAX_FOCAL_ERROR = 0.03
# A step is judged by so many frames of a model, at most and at least, before and after it.
_FRAMES, _MIN_FRAMES = 5, 3
# It is one where it exceeds the scatter of these frames so many times; a drift, as of focus, doesn't.
_MIN_SCATTERS = 8.0
# The scatter of estimates that happen to be nearly the same.
_MIN_SCATTER = 0.002


def with_focal_steps(intrinsics: pd.DataFrame, frames: pd.DataFrame, images: pd.DataFrame) -> pd.DataFrame:
    """Table sfm.intrinsics with the step of each session's focal lengths in each model, from import's frames and the
    rows of sfm.images in the same order."""
    adjusted = frames[["frame_id", "session_id", "t_ns"]].assign(
        model_id=images["model_id"].to_numpy(object), scale=images["fx"].to_numpy(float) / frames["fx"].to_numpy(float)
    )
    adjusted = adjusted.sort_values("t_ns", kind="stable")
    factors: list[float | None] = []
    first_ids: list[str | None] = []
    for row in intrinsics.itertuples(index=False):
        of_row = adjusted[(adjusted["model_id"] == row.model_id) & (adjusted["session_id"] == row.session_id)]
        step = focal_step(of_row["scale"].to_numpy(float))
        factors.append(None if step is None else step[1])
        first_ids.append(None if step is None else of_row["frame_id"].iloc[step[0]])
    return intrinsics.assign(
        focal_step=pd.Series(factors, dtype=float), focal_step_frame_id=pd.Series(first_ids, dtype=object)
    )


def focal_step(focal_scale_N: Array) -> tuple[int, float] | None:
    """The first frame after the clearest step in N frames' factors from logged focal lengths to those by images, in the
    order of time, and the step's factor, by the medians of five frames before and after it. None where there is none
    that is larger than the fraction MAX_FOCAL_ERROR."""
    log_scale = np.log(focal_scale_N)
    steps: list[tuple[float, int, float]] = []
    for first in range(_MIN_FRAMES, len(log_scale) - _MIN_FRAMES + 1):
        sides = (log_scale[max(first - _FRAMES, 0) : first], log_scale[first : first + _FRAMES])
        before, after = (float(np.median(side)) for side in sides)
        deviation = np.abs(np.concatenate([sides[0] - before, sides[1] - after]))
        scatter = max(SIGMA_OF_MEDIAN * float(np.median(deviation)), _MIN_SCATTER)
        if abs(after - before) > max(_MIN_SCATTERS * scatter, np.log1p(MAX_FOCAL_ERROR)):
            # Splits beside the step look like it, too, but for the frames that are on the wrong side.
            unexplained = float(np.minimum(deviation, abs(after - before)).mean())
            steps.append((unexplained / abs(after - before), first, float(np.exp(after - before))))
    return min(steps)[1:] if steps else None
