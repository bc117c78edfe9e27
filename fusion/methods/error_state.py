"""Method `error_state`: a textbook error-state Kalman filter on the camera's pose (six degrees of freedom).

Odometry's steps drive the pose, predictions correct it (Sola, "Quaternion kinematics for the error-state Kalman
filter", 2017, with the rotation error in the map's axes). Noise is white and its size given beforehand. An innovation
beyond the gate is thrown away, and where many are in a row the filter begins anew.
"""

from math import radians

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryLocaliser, OdometryOptions, raw
from groundwalk.geometry.poses import Array, inverse, relative, skew


class ErrorStateOptions(OdometryOptions):
    position_sd_m: float = Field(1.0, gt=0, description="a prediction's position error an axis")
    rotation_sd_deg: float = Field(4.0, gt=0, description="a prediction's rotation error an axis")
    drift_m: float = Field(0.03, gt=0, description="odometry's position drift over one metre, an axis, as random walk")
    drift_deg: float = Field(0.1, gt=0, description="odometry's rotation drift over one second, an axis")
    gate: float = Field(0.999, gt=0, lt=1, description="probability within which an innovation is believed")
    restart_after: int = Field(10, ge=1, description="predictions thrown away in a row after which to begin anew")


class ErrorState(OdometryLocaliser):
    """The filter. Its state is the newest pose map_T_cam and the covariance of its error, rotation before position."""

    options_type = ErrorStateOptions
    options: ErrorStateOptions

    def _forget(self) -> None:
        super()._forget()
        self._limit = float(chdtri(6, 1 - self.options.gate))
        variances = [radians(self.options.rotation_sd_deg) ** 2, self.options.position_sd_m**2]
        self._noise = np.diag(np.repeat(variances, 3))
        self._map_T_cam: Array | None = None
        self._P = self._noise.copy()
        self._refused = 0

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        if self._map_T_cam is not None and self._vio is not None:
            self._predict((t_ns - self._vio[0]) * 1e-9, relative(self._vio[1], vio_T_cam))
        signals: dict[str, float] = {}
        reasons: tuple[str, ...] = ()
        if map_T_cam_predicted is None:
            if self._map_T_cam is None:
                return raw(None)
            reasons = ("no_prediction",)
        elif self._map_T_cam is None:
            self._begin(map_T_cam_predicted)
            reasons = ("first_prediction",)
        else:
            signals["innovation2"] = self._correct(map_T_cam_predicted)
            if self._refused:
                reasons = ("outlier",)
                if self._refused >= self.options.restart_after:
                    self._begin(map_T_cam_predicted)
                    reasons = ("restart",)
        assert self._map_T_cam is not None
        map_T_vio = self._map_T_cam @ inverse(vio_T_cam)
        return Estimate(self._map_T_cam.copy(), Status.FUSED, self._P.copy(), map_T_vio, (), reasons, signals)

    def _begin(self, map_T_cam_predicted: Array) -> None:
        self._map_T_cam, self._P, self._refused = map_T_cam_predicted.copy(), self._noise.copy(), 0

    def _predict(self, seconds: float, step: Array) -> None:
        assert self._map_T_cam is not None
        moved = self._map_T_cam[:3, :3] @ step[:3, 3]
        F = np.eye(6)
        F[3:, :3] = -skew(moved)
        turned, strayed = radians(self.options.drift_deg) ** 2 * seconds, self.options.drift_m**2
        self._P = F @ self._P @ F.T
        # Standing still drifts a little too.
        added = np.repeat([turned, strayed * (float(np.linalg.norm(moved)) + 0.05 * seconds)], 3)
        self._P[np.arange(6), np.arange(6)] += added
        self._map_T_cam = self._map_T_cam @ step

    def _correct(self, map_T_cam_predicted: Array) -> float:
        """Take in a prediction, or refuse it; returns the squared innovation in standard deviations."""
        assert self._map_T_cam is not None
        turn = Rotation.from_matrix(map_T_cam_predicted[:3, :3] @ self._map_T_cam[:3, :3].T).as_rotvec()
        innovation = np.concatenate([turn, map_T_cam_predicted[:3, 3] - self._map_T_cam[:3, 3]])
        S = self._P + self._noise
        weighted = np.linalg.solve(S, np.column_stack([innovation, self._P]))
        squared = float(innovation @ weighted[:, 0])
        if squared > self._limit:
            self._refused += 1
            return squared
        self._refused = 0
        error = self._P @ weighted[:, 0]
        P = self._P - self._P @ weighted[:, 1:]
        self._P = (P + P.T) / 2
        self._map_T_cam[:3, :3] = Rotation.from_rotvec(error[:3]).as_matrix() @ self._map_T_cam[:3, :3]
        self._map_T_cam[:3, 3] += error[3:]
        return squared
