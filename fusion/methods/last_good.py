"""Method `last_good`: the last prediction that passed the paper's pair check, carried on by odometry.

The simplest use of odometry: no average, no memory beyond one frame, no going back.
"""

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryLocaliser, PairOptions, Predicted, check_pair, raw
from groundwalk.geometry.poses import Array, inverse


class LastGood(OdometryLocaliser):
    """Answers with predictions that are consistent with the one before, otherwise with odometry carried from the last
    of them; until there is one, with the raw prediction."""

    options_type = PairOptions
    options: PairOptions

    def _forget(self) -> None:
        super()._forget()
        self._last: Predicted | None = None
        self._map_T_vio: Array | None = None

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        signals: dict[str, float] = {}
        reason = "no_prediction"
        if map_T_cam_predicted is not None:
            last, self._last = self._last, (t_ns, map_T_cam_predicted, vio_T_cam)
            reason, signals = check_pair(last, self._last, self.options) if last else ("first_prediction", {})
            if not reason:
                self._map_T_vio = map_T_cam_predicted @ inverse(vio_T_cam)
                return Estimate(map_T_cam_predicted, Status.RELIABLE, map_T_vio=self._map_T_vio, signals=signals)
        if self._map_T_vio is None:
            return raw(map_T_cam_predicted) if reason == "no_prediction" else raw(map_T_cam_predicted, reason)
        carried = self._map_T_vio @ vio_T_cam
        return Estimate(carried, Status.OPTIMISED, map_T_vio=self._map_T_vio, reasons=(reason,), signals=signals)
