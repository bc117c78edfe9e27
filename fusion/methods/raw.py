"""Method `raw`: the raw prediction, which every other method is held against."""

from groundwalk.fusion.methods.localiser import Estimate, Localiser, MethodOptions
from groundwalk.fusion.methods.odometry import raw
from groundwalk.geometry.poses import Array


class Raw(Localiser):
    """Answers each frame with its prediction, and nothing where there is none."""

    options_type = MethodOptions

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        return raw(map_T_cam_predicted)
