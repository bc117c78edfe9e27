"""Method `smoother`: `drift_aware` that answers late: `lag_s` seconds, or after the whole walk, for labelling.

It is the same fit. Later predictions re-weigh earlier ones, and the alignment at an earlier keyframe is read from it.
"""

from math import inf

from pydantic import Field

from groundwalk.fusion.methods.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.methods.localiser import Estimate
from groundwalk.fusion.methods.offline import Offline, frames, steps
from groundwalk.fusion.walk import Walk


class SmootherOptions(DriftAwareOptions):
    """The same assumptions, and how long an answer may wait."""

    lag_s: float | None = Field(None, ge=0, description="seconds after which a frame is answered; none: after the walk")


class Smoother(Offline):
    """Each frame's pose from what is known `lag_s` later. A frame without odometry has its raw prediction."""

    def __init__(self, options: SmootherOptions | None = None) -> None:
        self.options = options or SmootherOptions()

    def estimates(self, walk: Walk) -> list[Estimate]:
        lag_s = inf if self.options.lag_s is None else self.options.lag_s
        localiser, walked = DriftAware(self.options, lag_s), frames(walk)
        in_time: list[Estimate] = []
        late: list[Estimate] = []

        def answer(until_ns: float) -> None:
            while len(late) < len(in_time) and walk.t_ns[len(late)] <= until_ns:
                t_ns, vio_T_cam, predicted, _, covariance = walked[len(late)]
                revised = None if vio_T_cam is None else localiser.revised(t_ns, vio_T_cam, predicted, covariance)
                late.append(revised or in_time[len(late)])

        for t_ns, estimate in zip(walk.t_ns, steps(localiser, walk), strict=True):
            in_time.append(estimate)
            answer(t_ns - lag_s * 1e9)
        localiser.settle()
        answer(inf)
        return late
