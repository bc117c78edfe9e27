"""Method `raw`: the raw prediction, which every other method is held against."""

from groundwalk.fusion.methods.localiser import Estimate, Localiser, MethodOptions, Status
from groundwalk.geometry.poses import Array


class Raw(Localiser):
    """Answers each frame with its prediction, and nothing where there is none."""

    options_type = MethodOptions

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        if map_T_cam_predicted is None:
            return Estimate(None, Status.NONE, reasons=("no_prediction",))
        return Estimate(map_T_cam_predicted, Status.PREDICTED)
