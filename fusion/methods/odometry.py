"""What methods must know of odometry: that it can be lost, that it can jump, and the paper's test of a prediction
(section III-A): does it move as odometry does from the prediction before? And method `raw`, which has none."""

import operator
from abc import abstractmethod
from typing import Literal

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Localiser, MethodOptions, Status
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import relative_error, rpe_roe


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
    _vio: tuple[int, Array] | None

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        if vio_T_cam is None:
            return raw(map_T_cam_predicted, "no_odometry")
        jumped = self._vio is not None and have_jumped(
            (t_ns - self._vio[0]) * 1e-9, float(np.linalg.norm(vio_T_cam[:3, 3] - self._vio[1][:3, 3])), self.options
        )
        if jumped:
            self._forget()
        estimate = self._fuse(t_ns, vio_T_cam, map_T_cam_predicted)
        self._vio = (t_ns, vio_T_cam)
        return estimate.because("odometry_jump") if jumped else estimate

    @abstractmethod
    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        """The estimate for a frame with odometry; `_vio` is still the last one."""

    def _forget(self) -> None:
        self._vio = None


def raw(map_T_cam_predicted: Array | None, *reasons: str) -> Estimate:
    """The prediction as it is, or nothing where there is none."""
    if map_T_cam_predicted is None:
        return Estimate(None, Status.NONE, reasons=(*reasons, "no_prediction"))
    return Estimate(map_T_cam_predicted, Status.PREDICTED, reasons=reasons)


class Raw(Localiser):
    """Answers each frame with its prediction, and nothing where there is none."""

    options_type = MethodOptions

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        return raw(map_T_cam_predicted)


class PairOptions(OdometryOptions):
    d_th_m: float = Field(0.4, ge=0, description="d_th: largest relative position error of a consistent pair")
    o_th_deg: float = Field(4.0, ge=0, description="o_th: largest relative orientation error of a consistent pair")
    rotation_step: Literal["scalar_part", "norm"] = Field(
        "scalar_part", description="what arccos is taken of; the norm, as printed, makes every rotation step 0"
    )
    pair_check: Literal["lengths", "se3"] = Field(
        "lengths", description="compare the lengths of the steps, or the whole relative poses"
    )
    comparison: Literal["<=", "<"] = Field("<=", description="how an error compares with d_th and o_th")
    interval_s: float = Field(1.0, gt=0, description="time between consecutive predictions")
    interval_tolerance_s: float = Field(0.5, gt=0, description="a pair further off this interval isn't consecutive")

    @property
    def gates(self) -> dict[str, float]:
        return {"rpe_m": self.d_th_m, "roe_deg": self.o_th_deg}


Predicted = tuple[int, Array, Array]
"""A frame with a prediction: t_ns, map_T_cam_predicted (4, 4) and vio_T_cam (4, 4)."""


def check_pair(last: Predicted, now: Predicted, options: PairOptions) -> tuple[str, dict[str, float]]:
    """What keeps a frame and the one before it from being a consistent pair, or nothing, and the pair's errors.

    RPE and ROE compare the lengths of the steps; with `se3`, the relative poses.
    """
    if abs((now[0] - last[0]) * 1e-9 - options.interval_s) > options.interval_tolerance_s:
        return "gap", {}
    error = relative_error if options.pair_check == "se3" else rpe_roe
    rpe_m, roe_deg = (float(e[0]) for e in error(*(np.array([last[i], now[i]]) for i in (1, 2))))
    if options.pair_check == "lengths" and options.rotation_step == "norm":
        roe_deg = 0.0
    within = operator.lt if options.comparison == "<" else operator.le
    consistent = within(rpe_m, options.d_th_m) and within(roe_deg, options.o_th_deg)
    return "" if consistent else "pair_inconsistent", {"rpe_m": rpe_m, "roe_deg": roe_deg}
