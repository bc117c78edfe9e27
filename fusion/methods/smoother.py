"""Method `smoother`: `drift_aware` that answers after the whole walk, for labelling.

It is the same fit. Later predictions re-weigh earlier ones, and the alignment at an earlier keyframe is read from it.
"""

from groundwalk.fusion.methods.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.methods.localiser import Estimate
from groundwalk.fusion.methods.offline import Offline, frames, stepped
from groundwalk.fusion.walk import Walk


class Smoother(Offline):
    """Each frame's pose from what is known in the end. A frame without odometry has its raw prediction."""

    def __init__(self, options: DriftAwareOptions | None = None) -> None:
        self.options = options or DriftAwareOptions()

    def estimates(self, walk: Walk) -> list[Estimate]:
        localiser = DriftAware(self.options, forgetful=False)
        in_time = stepped(localiser, walk)
        localiser.settle()
        late: list[Estimate] = []
        for estimate, (t_ns, vio_T_cam, predicted, _, covariance) in zip(in_time, frames(walk), strict=True):
            revised = None if vio_T_cam is None else localiser.revised(t_ns, vio_T_cam, predicted, covariance)
            late.append(revised or estimate)
        return late
