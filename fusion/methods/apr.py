"""Method `apr`: the raw regressor, which every other method is held against."""

from groundwalk.fusion.methods.localiser import Estimate, Localiser, MethodOptions, Status
from groundwalk.geometry.poses import Array


class AprOptions(MethodOptions):
    """The raw regressor has no options."""


class Apr(Localiser):
    """Answers each frame with its prediction, and nothing where there is none."""

    def __init__(self, options: AprOptions | None = None) -> None:
        super().__init__()
        self.options = options or AprOptions()

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if map_T_cam_apr is None:
            return Estimate(None, Status.NONE, reasons=("no_prediction",))
        return Estimate(map_T_cam_apr, Status.PREDICTED)
