"""Methods `pose_graph` and `global_graph`: frames as a chain, held by predictions and odometry's steps between them.

The post-processing of MapNet (Brahmbhatt et al., CVPR 2018, section 3.4) on a sliding window: each prediction is an
absolute measurement, odometry gives the relative ones, and the window's poses are those that fit both best. And the
global pose graph of VINS-Fusion (Qin et al., arXiv:1901.03642), which keeps the walk and has Huber's loss, with
predictions in place of GPS.
"""

from collections import deque
from math import inf, radians
from typing import ClassVar

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryLocaliser, OdometryOptions, raw
from groundwalk.geometry.pose_graph import smooth_chain
from groundwalk.geometry.poses import Array, inverse, relative


class PoseGraphOptions(OdometryOptions):
    frames: int = Field(10, ge=2, description="frames with a prediction that the window holds")
    position_sd_m: float = Field(1.0, gt=0, description="a prediction's position error an axis")
    rotation_sd_deg: float = Field(4.0, gt=0, description="a prediction's rotation error an axis")
    step_sd_m: float = Field(0.05, gt=0, description="odometry's position error from one of them to the next, an axis")
    step_sd_deg: float = Field(0.3, gt=0, description="odometry's rotation error from one of them to the next, an axis")
    huber: ClassVar[float] = inf  # standard deviations


class GlobalGraphOptions(PoseGraphOptions):
    frames: int = Field(500, ge=2, description="frames with a prediction that the graph holds")
    huber: ClassVar[float] = 1.0


class PoseGraph(OdometryLocaliser):
    """Answers with the newest pose of the window, carried on by odometry between predictions."""

    options_type = PoseGraphOptions
    options: PoseGraphOptions

    def _forget(self) -> None:
        super()._forget()
        # Prediction, odometry and the last solution, each (4, 4), of the frames in the window.
        self._window: deque[tuple[Array, Array, Array]] = deque(maxlen=self.options.frames)
        self._covariance: Array | None = None  # (6, 6) of the newest

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        if map_T_cam_predicted is not None:
            self._solve(vio_T_cam, map_T_cam_predicted)
        elif not self._window:
            return raw(None)
        _, newest_vio, newest = self._window[-1]
        map_T_vio = newest @ inverse(newest_vio)
        pose = map_T_vio @ vio_T_cam
        reasons = ("no_prediction",) if map_T_cam_predicted is None else ()
        covariance = None
        if map_T_cam_predicted is not None and self._covariance is not None:
            turn = np.eye(6)
            turn[:3, :3] = pose[:3, :3]
            covariance = turn @ self._covariance @ turn.T
        return Estimate(pose, Status.FUSED, covariance, map_T_vio, reasons=reasons)

    def _solve(self, vio_T_cam: Array, map_T_cam_predicted: Array) -> None:
        o = self.options
        start = map_T_cam_predicted
        if self._window:
            _, last_vio, last = self._window[-1]
            start = last @ relative(last_vio, vio_T_cam)
        self._window.append((map_T_cam_predicted, vio_T_cam, start))
        predicted, vio, guess = (np.array(poses) for poses in zip(*self._window, strict=True))
        measured_sd, step_sd = (o.position_sd_m, radians(o.rotation_sd_deg)), (o.step_sd_m, radians(o.step_sd_deg))
        steps = relative(vio[:-1], vio[1:])
        solved, self._covariance = smooth_chain(
            predicted, steps, guess, measured_sd=measured_sd, step_sd=step_sd, huber=o.huber
        )
        self._window.extend(zip(predicted, vio, solved, strict=True))
