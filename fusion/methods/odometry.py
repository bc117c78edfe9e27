"""What every method must know of odometry: that it can be lost, and that it can jump."""

from abc import abstractmethod

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Localiser, MethodOptions, State, Status, plain
from groundwalk.geometry.poses import Array


class OdometryOptions(MethodOptions):
    vio_speed_m_s: float = Field(2.0, gt=0, description="fastest motion that odometry is believed without question")
    vio_jump_m: float = Field(1.0, gt=0, description="motion beyond that speed that counts as an odometry jump")


def have_jumped(seconds: float | Array, moved_m: float | Array, options: OdometryOptions) -> Array:
    """Whether odometry that moved by `moved_m` within `seconds` has jumped; numbers or arrays (N,)."""
    return np.asarray(moved_m > options.vio_speed_m_s * seconds + options.vio_jump_m)


class OdometryLocaliser(Localiser):
    """A localiser for which odometry carries the camera on between predictions.

    Without odometry it answers with the raw prediction. An odometry jump makes it forget everything: a localiser that
    knows better overrides `_advance`.
    """

    options: OdometryOptions

    def __init__(self) -> None:
        super().__init__()
        self._vio: tuple[int, Array] | None = None

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if vio_T_cam is None:
            return raw(map_T_cam_apr, "no_odometry")
        jumped = self._vio is not None and have_jumped(
            (t_ns - self._vio[0]) * 1e-9,
            float(np.linalg.norm(vio_T_cam[:3, 3] - self._vio[1][:3, 3])),
            self.options,
        )
        if jumped:
            self._forget()
        estimate = self._fuse(t_ns, vio_T_cam, map_T_cam_apr)
        self._vio = (t_ns, vio_T_cam)
        return estimate.because("odometry_jump") if jumped else estimate

    @abstractmethod
    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_apr: Array | None) -> Estimate:
        """The estimate for a frame with odometry; `_vio` is still the last one."""

    def _forget(self) -> None:
        self._vio = None

    def _state(self) -> State:
        return {"vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])]}

    def _set_state(self, state: State) -> None:
        self._forget()
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))


def raw(map_T_cam_apr: Array | None, *reasons: str) -> Estimate:
    """The prediction as it is, or nothing where there is none."""
    if map_T_cam_apr is None:
        return Estimate(None, Status.NONE, reasons=(*reasons, "no_prediction"))
    return Estimate(map_T_cam_apr, Status.PREDICTED, reasons=reasons)
