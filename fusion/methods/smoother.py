"""Method `smoother`: `drift_aware` that answers late: `lag_s` seconds, or after the whole walk, for labelling.

It is the same fit. Later predictions re-weigh earlier ones, and the alignment at an earlier keyframe is read from it.
"""

from math import inf

from pydantic import Field

from groundwalk.fusion.methods.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.methods.error_map import ErrorMap
from groundwalk.fusion.methods.localiser import Estimate
from groundwalk.fusion.methods.offline import Offline, steps
from groundwalk.fusion.walk import Walk, known


class SmootherOptions(DriftAwareOptions):
    """The same assumptions, and how long an answer may wait."""

    lag_s: float | None = Field(None, ge=0, description="seconds after which a frame is answered; none: after the walk")


class Smoother(Offline):
    """Each frame's pose from what is known `lag_s` later. A frame without odometry has its raw prediction."""

    def __init__(self, options: SmootherOptions | None = None, error_map: ErrorMap | None = None) -> None:
        self.options = options or SmootherOptions()
        self._error_map = error_map

    def causal(self, lag_s: float) -> DriftAware:
        """The fit that keeps what answers of that lag need."""
        return DriftAware(self.options, self._error_map, lag_s)

    def estimates(self, walk: Walk) -> list[Estimate]:
        lag_s = inf if self.options.lag_s is None else self.options.lag_s
        localiser, has_vio = self.causal(lag_s), known(walk.vio_T_cam)
        in_time: list[Estimate] = []
        late: list[Estimate] = []

        def answer(until_ns: float) -> None:
            while len(late) < len(in_time) and walk.t_ns[len(late)] <= until_ns:
                i = len(late)
                revised = localiser.revised(int(walk.t_ns[i]), walk.vio_T_cam[i]) if has_vio[i] else None
                late.append(revised or in_time[i])

        for t_ns, estimate in zip(walk.t_ns, steps(localiser, walk), strict=True):
            in_time.append(estimate)
            answer(t_ns - lag_s * 1e9)
        localiser.settle()
        answer(inf)
        return late
