"""Method `window30`: the rigid alignment that fits the last 30 pairs of prediction and odometry best, robustly."""

from collections import deque
from math import radians

import numpy as np
from pydantic import Field

from groundwalk.consistency.windows import PoseSd, fit_rigid
from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryLocaliser, OdometryOptions, raw
from groundwalk.geometry.poses import Array

_TOLERANCE = 1e-3  # of the weights; the alignment is a centimetre's matter at best


class WindowOptions(OdometryOptions):
    pairs: int = Field(30, ge=1, description="pairs of prediction and odometry that the alignment is fitted to")
    position_sd_m: float = Field(0.5, gt=0, description="a prediction's position error that weighs as much as ...")
    rotation_sd_deg: float = Field(4.0, gt=0, description="... this rotation error; errors below both never count less")


class Window(OdometryLocaliser):
    """Answers with odometry carried by the alignment: least squares with outliers weighed down (Geman and McClure)."""

    options_type = WindowOptions
    options: WindowOptions

    def _forget(self) -> None:
        super()._forget()
        self._pairs: deque[tuple[Array, Array]] = deque(maxlen=self.options.pairs)  # map_T_cam, vio_T_cam
        self._map_T_vio: Array | None = None

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        if map_T_cam_predicted is not None:
            self._pairs.append((map_T_cam_predicted, vio_T_cam))
            map_T_cam, vio = (np.array(poses) for poses in zip(*self._pairs, strict=True))
            sd = PoseSd(self.options.position_sd_m, radians(self.options.rotation_sd_deg))
            self._map_T_vio = fit_rigid(map_T_cam, vio, sd, tolerance=_TOLERANCE)[0]
        if self._map_T_vio is None:
            return raw(map_T_cam_predicted)
        reasons = ("no_prediction",) if map_T_cam_predicted is None else ()
        return Estimate(self._map_T_vio @ vio_T_cam, Status.OPTIMISED, map_T_vio=self._map_T_vio, reasons=reasons)
