"""Method `last_good`: the last prediction that passed the paper's pair check, carried on by odometry.

The simplest use of odometry: no average, no memory beyond one frame, no going back.
"""

from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.localiser import Estimate, State, Status, array, plain
from groundwalk.fusion.methods.odometry import OdometryLocaliser, raw
from groundwalk.fusion.methods.pair_check import PairOptions, are_consecutive, are_consistent, pair_errors
from groundwalk.geometry.poses import Array, inverse


class LastGoodOptions(PairOptions):
    """The options of the pair check."""


class _Pair(NamedTuple):
    t_ns: int
    vio_T_cam: Array
    map_T_cam: Array


class LastGood(OdometryLocaliser):
    """Answers with predictions that are consistent with the one before, otherwise with odometry carried from the last
    of them; until there is one, with the raw prediction."""

    def __init__(self, options: LastGoodOptions | None = None) -> None:
        super().__init__()
        self.options: LastGoodOptions = options or LastGoodOptions()
        self._forget()

    def _forget(self) -> None:
        super()._forget()
        self._last: _Pair | None = None  # the newest frame with a prediction
        self._map_T_vio: Array | None = None

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_apr: Array | None) -> Estimate:
        signals: dict[str, float] = {}
        reason = "no_prediction"
        if map_T_cam_apr is not None:
            last, self._last = self._last, _Pair(t_ns, vio_T_cam, map_T_cam_apr)
            reason = "first_prediction" if last is None else "gap"
            if last is not None and are_consecutive((t_ns - last.t_ns) * 1e-9, self.options):
                rpe_m, roe_deg = pair_errors(
                    np.array([last.map_T_cam, map_T_cam_apr]), np.array([last.vio_T_cam, vio_T_cam]), self.options
                )
                signals = {"rpe_m": float(rpe_m[0]), "roe_deg": float(roe_deg[0])}
                if are_consistent(signals["rpe_m"], signals["roe_deg"], self.options):
                    self._map_T_vio = map_T_cam_apr @ inverse(vio_T_cam)
                    return Estimate(map_T_cam_apr, Status.RELIABLE, map_T_vio=self._map_T_vio, signals=signals)
                reason = "pair_inconsistent"
        if self._map_T_vio is None:
            return raw(map_T_cam_apr) if reason == "no_prediction" else raw(map_T_cam_apr, reason)
        carried = self._map_T_vio @ vio_T_cam
        return Estimate(carried, Status.OPTIMISED, map_T_vio=self._map_T_vio, reasons=(reason,), signals=signals)

    def _state(self) -> State:
        last = self._last
        return super()._state() | {
            "last": None if last is None else [last.t_ns, plain(last.vio_T_cam), plain(last.map_T_cam)],
            "map_T_vio": plain(self._map_T_vio),
        }

    def _set_state(self, state: State) -> None:
        super()._set_state(state)
        if state["last"] is not None:
            t_ns, vio, apr = state["last"]
            self._last = _Pair(t_ns, np.array(vio), np.array(apr))
        self._map_T_vio = array(state["map_T_vio"])
