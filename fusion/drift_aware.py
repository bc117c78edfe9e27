"""Method `drift_aware`: the alignment as a slowly drifting state, estimated from all the history.

Odometry and map are both gravity-aligned, so odometry drifts in yaw and position only. A Kalman filter carries the
camera's map position and the yaw between the frames, and beside them the regressor's bias at this place, which
fades as the camera moves on: neighbouring predictions share their error, and counting them as independent would
make the filter far too sure. How wrong predictions are is learnt as the walk goes on, for the walk as a whole and for
the place: a prediction whose gravity disagrees with odometry's, or whose error changes fast, is a bad one, which shows
within one frame and needs no threshold in metres. What still doesn't fit has the tails of Student's t. Several filters
that believe odometry less and less run side by side and share their states by how well they predict (interacting
multiple models, Blom and Bar-Shalom 1988), so that bad odometry is answered by following the regressor.
"""

from math import acos, atan2, exp, pi, radians, sqrt
from typing import Any

import numpy as np
from pydantic import Field

from fusion.localiser import Estimate, Localiser, MethodOptions, State, Status, plain
from geometry.poses import Array, make_pose, yaw_rotation

# The state of each filter: yaw of map_R_vio and the camera's map position, then the regressor's bias in these four,
# in units of its local standard deviation.
_ALIGNMENT, _BIAS = slice(0, 4), slice(4, 8)
_I4, _I8 = np.arange(4), np.arange(8)
# Where the scales of (yaw, x, y, z) stand among the learnt ones (horizontal, vertical, yaw, tilt).
_AXES = np.array([2, 0, 1, 0])
_HORIZONTAL, _VERTICAL, _YAW, _TILT = range(4)


class DriftAwareOptions(MethodOptions):
    """What the filter assumes of odometry and of the regressor before it has seen them."""

    position_sd_m: float = Field(1.5, gt=0, description="a prediction's first assumed error a horizontal axis")
    yaw_sd_deg: float = Field(5.0, gt=0, description="a prediction's first assumed yaw error, and tilt error an axis")
    memory_frames: float = Field(80.0, gt=1, description="predictions over which the scales of errors are learnt")
    prior_frames: float = Field(4.0, gt=0, description="predictions that the first assumptions count as")
    bias: bool = Field(True, description="model the error that neighbouring predictions share")
    bias_length_m: float = Field(4.0, gt=0, description="motion over which the shared error fades to 1/e")
    turn_length_m: float = Field(2.0, ge=0, description="motion that a turn by one radian counts as")
    noise_share: float = Field(0.5, gt=0, le=1, description="share of a prediction's variance that isn't shared")
    local_scale: bool = Field(True, description="learn how wrong predictions are here, from tilt and sudden changes")
    tilt: bool = Field(True, description="use the angle between the prediction's gravity and odometry's")
    cross: float = Field(0.5, ge=0, le=1, description="weight of rotation's evidence on position's scale, and back")
    place_decay: float = Field(0.6, gt=0, lt=1, description="what is left of local evidence after a metre")
    degrees_of_freedom: float = Field(2.0, gt=0, description="of Student's t, the tails of what still doesn't fit")
    drift_m: float = Field(0.03, gt=0, description="odometry's drift over one metre, one sigma, as a random walk")
    drift_deg: float = Field(0.1, gt=0, description="odometry's yaw drift over one second, one sigma")
    distrust: list[float] = Field([1.0, 10.0, 100.0, 1000.0], min_length=1, description="drift variances tried")
    switch: float = Field(0.001, gt=0, lt=0.5, description="probability a frame that odometry's quality changes")
    evidence: float = Field(0.2, gt=0, le=1, description="how much a prediction counts in judging odometry's quality")
    vio_speed_m_s: float = Field(2.0, gt=0, description="fastest motion that odometry is believed without question")
    vio_jump_m: float = Field(1.0, gt=0, description="motion beyond that speed that counts as an odometry jump")
    tilt_sd_deg: float = Field(0.3, gt=0, description="odometry's gravity error an axis")
    covariance_factor: float = Field(1.5, gt=0, description="what the filter's covariance is multiplied with")


class DriftAware(Localiser):
    """The filter. Every frame from the first prediction on gets a pose and a covariance."""

    def __init__(self, options: DriftAwareOptions | None = None) -> None:
        super().__init__()
        self.options = options or DriftAwareOptions()
        levels = len(self.options.distrust)
        self._distrust = np.array(self.options.distrust)
        # Odometry's quality changes to a neighbouring level.
        stay = np.eye(levels)
        near = (np.abs(np.subtract.outer(_I8[:levels], _I8[:levels])) == 1) if levels > 1 else stay
        self._switching = (1 - self.options.switch) * stay + self.options.switch * near / near.sum(1, keepdims=True)
        self._forget()

    def _forget(self) -> None:
        o = self.options
        position, angle = o.position_sd_m**2, radians(o.yaw_sd_deg) ** 2
        # Learnt variances of predictions, typical over the walk; of their change from one to the next.
        self._scale = np.array([position, position / 4, angle, angle])
        self._change = np.array([position, angle])
        self._seen = o.prior_frames
        self._evidence, self._evidence_frames = np.zeros(3), 0.0  # tilt, position change, yaw change, at this place
        self._error: Array | None = None  # of the last prediction (4,), as the filters saw it
        self._state_x: Array | None = None  # (L, 8), L levels of distrust
        self._P = np.zeros((0, 8, 8))
        self._weight = np.zeros(0)
        self._vio: tuple[int, Array] | None = None
        self._lost = False

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if vio_T_cam is None:
            self._lost = self._vio is not None
            if map_T_cam_apr is None:
                return Estimate(None, Status.NONE, reasons=("no_odometry", "no_prediction"))
            return Estimate(map_T_cam_apr, Status.PREDICTED, self._raw_covariance(), reasons=("no_odometry",))
        reasons: tuple[str, ...] = ()
        moved = 0.0
        if self._state_x is not None:
            moved, jumped = self._predict(t_ns, vio_T_cam)
            reasons = ("odometry_jump",) if jumped else ()
        self._vio, self._lost = (t_ns, vio_T_cam), False
        if map_T_cam_apr is None:
            if self._state_x is None:
                return Estimate(None, Status.NONE, reasons=("no_prediction",))
            return self._estimate(vio_T_cam, (*reasons, "no_prediction"), {})
        offset = map_T_cam_apr[:3, :3] @ vio_T_cam[:3, :3].T
        measured = np.array([atan2(offset[0, 2] - offset[2, 0], offset[0, 0] + offset[2, 2]), *map_T_cam_apr[:3, 3]])
        down = -vio_T_cam[1, :3] if gravity is None else gravity
        tilt = acos(min(1.0, max(-1.0, float(-map_T_cam_apr[1, :3] @ down))))
        if self._state_x is None:
            self._begin(measured)
            return self._estimate(vio_T_cam, ("first_prediction",), {"tilt_deg": tilt * 180 / pi})
        signals = self._correct(measured, tilt, moved)
        return self._estimate(vio_T_cam, reasons, {"tilt_deg": tilt * 180 / pi, **signals})

    def _begin(self, measured: Array) -> None:
        """The first prediction is all there is: the state is what it says, as uncertain as it is."""
        levels = len(self._distrust)
        variance = 2 * self._scale[_AXES]
        P = np.zeros((8, 8))
        P[_I4, _I4] = variance
        P[_I4 + 4, _I4 + 4] = 1.0
        if self.options.bias:
            P[_I4, _I4 + 4] = P[_I4 + 4, _I4] = -np.sqrt((1 - self.options.noise_share) * variance)
        self._state_x = np.tile(np.concatenate([measured, np.zeros(4)]), (levels, 1))
        self._P = np.tile(P, (levels, 1, 1))
        weight: Array = np.power(0.1, np.arange(levels))
        self._weight = weight / weight.sum()
        self._error = np.zeros(4)

    def _predict(self, t_ns: int, vio_T_cam: Array) -> tuple[float, bool]:
        """Carry the state along odometry; returns the motion in metres (turns counted in) and whether it jumped."""
        assert self._vio is not None and self._state_x is not None
        o = self.options
        self._mix()
        x, P = self._state_x, self._P  # x is changed in place
        seconds = (t_ns - self._vio[0]) * 1e-9
        step = vio_T_cam[:3, 3] - self._vio[1][:3, 3]
        length = sqrt(float(step @ step))
        cosine = (float(np.sum(vio_T_cam[:3, :3] * self._vio[1][:3, :3])) - 1) / 2
        moved = length + o.turn_length_m * acos(min(1.0, max(-1.0, cosine)))
        jumped = length > o.vio_speed_m_s * seconds + o.vio_jump_m

        c, s = np.cos(x[:, 0]), np.sin(x[:, 0])
        east, north = c * step[0] + s * step[2], c * step[2] - s * step[0]
        x[:, 1] += east
        x[:, 2] += step[1]
        x[:, 3] += north
        kept = exp(-moved / o.bias_length_m)
        x[:, _BIAS] *= kept
        F = np.zeros_like(P)
        F[:, _I8, _I8] = [1, 1, 1, 1, kept, kept, kept, kept]
        F[:, 1, 0], F[:, 3, 0] = north, -east
        P = F @ P @ F.transpose(0, 2, 1)
        # Standing still drifts a little too.
        position: Array = self._distrust * (o.drift_m**2 * (length + 0.05 * seconds))
        yaw: Array = self._distrust * (radians(o.drift_deg) ** 2 * seconds)
        if jumped or self._lost:
            # Where odometry went unwatched, it may have lost the fastest walk, and its heading.
            position = position + length**2 + (o.vio_speed_m_s * seconds) ** 2
            yaw = yaw + radians(20.0) ** 2
        P[:, 0, 0] += yaw
        P[:, 1, 1] += position
        P[:, 2, 2] += position / 4
        P[:, 3, 3] += position
        P[:, _I4 + 4, _I4 + 4] += 1 - kept**2
        self._P = P
        return moved, jumped

    def _mix(self) -> None:
        """Share the levels' states by how probably odometry has changed from one to the other."""
        assert self._state_x is not None
        if len(self._weight) == 1:
            return
        joint = self._switching * self._weight[:, None]
        weight = joint.sum(axis=0)
        share = (joint / weight).T  # (to, from)
        x = share @ self._state_x
        apart = self._state_x[None] - x[:, None]
        self._P = np.einsum("tf,fij->tij", share, self._P) + np.einsum("tf,tfi,tfj->tij", share, apart, apart)
        self._state_x, self._weight = x, weight

    def _correct(self, measured: Array, tilt: float, moved: float) -> dict[str, float]:
        """Take in a prediction; returns the numbers behind what it was worth."""
        assert self._state_x is not None and self._error is not None
        o, x, P = self.options, self._state_x, self._P
        error = measured - x[:, _ALIGNMENT]  # (L, 4)
        error[:, 0] = _wrapped(error[:, 0])
        now = self._weight @ error
        position_scale, angle_scale = self._local_scale(now, tilt, moved)
        local = np.array([angle_scale, position_scale, position_scale, position_scale])
        variance = self._scale[_AXES] * local
        share = o.noise_share if o.bias else 1.0

        def innovation(variance: Array) -> tuple[Array, Array, Array]:
            h = np.sqrt((1 - share) * variance)
            HP = P[:, _ALIGNMENT] + h[:, None] * P[:, _BIAS]
            S = HP[:, :, _ALIGNMENT] + HP[:, :, _BIAS] * h
            S[:, _I4, _I4] += share * variance
            return error - h * x[:, _BIAS], HP, S

        r, HP, S = innovation(variance)
        d2 = np.einsum("li,li->l", r, np.linalg.solve(S, r[..., None])[..., 0])
        nu = o.degrees_of_freedom
        log_likelihood = -(nu + 4) / 2 * np.log1p(d2 / nu) - np.log(np.linalg.det(S)) / 2
        # Errors that the model takes for independent aren't quite, so a frame counts as less evidence than it looks.
        posterior = self._weight * np.exp(o.evidence * (log_likelihood - log_likelihood.max()))
        self._weight = np.maximum(posterior / posterior.sum(), 1e-6)
        self._weight /= self._weight.sum()
        surprise = float(self._weight @ d2)
        trust = min(1.0, (nu + 4) / (nu + surprise))
        if trust < 1:
            r, HP, S = innovation(variance / trust)
        K = np.linalg.solve(S, HP).transpose(0, 2, 1)
        x += (K @ r[..., None])[..., 0]
        x[:, 0] = x[0, 0] + _wrapped(x[:, 0] - x[0, 0])
        P = P - K @ HP
        self._P = (P + P.transpose(0, 2, 1)) / 2
        self._learn(measured, local)
        return {"surprise": surprise, "local_scale": sqrt(position_scale), "trust": trust}

    def _local_scale(self, error: Array, tilt: float, moved: float) -> tuple[float, float]:
        """How much larger than usual the variances of position and angle are at this place.

        Evidence: the tilt (two axes), and how much the error changed since the last prediction, both of which are known
        whatever the alignment is. It fades as the camera moves on.
        """
        o = self.options
        assert self._error is not None
        change = error - self._error
        change[0] = _wrapped(change[0])
        tilt2 = tilt**2 / 2 if o.tilt else self._scale[_TILT]
        fresh = np.array([tilt2, (change[1] ** 2 + change[3] ** 2) / 2, change[0] ** 2])
        typical = np.array([self._scale[_TILT], *self._change])
        relative = fresh / typical
        kept = o.place_decay**moved
        self._evidence = kept * self._evidence + relative * [2, 2, 1]
        self._evidence_frames = kept * self._evidence_frames + 1
        # What is typical is learnt as a t distribution's scale, which bad predictions hardly move.
        rate = 1 / (self._seen + 1)
        nu = o.degrees_of_freedom
        weight = (nu + 2) / (nu + 2 * relative)
        learnt = np.maximum((1 - rate) * typical + rate * fresh * weight, [radians(0.3) ** 2, 1e-4, 1e-6])
        self._scale[_TILT], self._change = learnt[0], learnt[1:]
        if not o.local_scale:
            return 1.0, 1.0
        tilts, positions, yaws = self._evidence
        n = self._evidence_frames
        position = (nu + positions + o.cross * tilts) / (nu + 2 * n + o.cross * 2 * n)
        angle = (nu + tilts + yaws + o.cross * positions) / (nu + 3 * n + o.cross * 2 * n)
        return float(position), float(angle)

    def _learn(self, measured: Array, local: Array) -> None:
        """Update the predictions' typical variances from what the corrected alignment leaves over."""
        assert self._state_x is not None
        x, P = self._mean()
        error = measured - x[_ALIGNMENT]
        error[0] = _wrapped(error[0])
        self._error = error
        square = error**2 + P[_I4, _I4]
        left = np.array([(square[1] + square[3]) / 2, square[2], square[0]])
        place = np.array([local[1], local[1], local[0]])
        nu = self.options.degrees_of_freedom
        weight = (nu + 1) / (nu + left / self._scale[:3] / place) / place
        rate = 1 / (self._seen + 1)
        self._scale[:3] = np.maximum((1 - rate) * self._scale[:3] + rate * left * weight, [1e-3, 1e-4, 1e-6])
        self._seen = min(self._seen + 1, self.options.memory_frames)

    def _mean(self) -> tuple[Array, Array]:
        """The levels' mean state (8,) and covariance (8, 8)."""
        assert self._state_x is not None
        x = self._weight @ self._state_x
        apart = self._state_x - x
        return x, np.einsum("l,lij->ij", self._weight, self._P) + (self._weight * apart.T) @ apart

    def _estimate(self, vio_T_cam: Array, reasons: tuple[str, ...], signals: dict[str, float]) -> Estimate:
        x, P = self._mean()
        map_T_cam = make_pose(yaw_rotation(x[0]) @ vio_T_cam[:3, :3], x[1:4])
        map_T_vio = make_pose(yaw_rotation(x[0]), x[1:4] - yaw_rotation(x[0]) @ vio_T_cam[:3, 3])
        covariance = np.zeros((6, 6))
        covariance[[0, 2], [0, 2]] = radians(self.options.tilt_sd_deg) ** 2
        covariance[np.ix_([1, 3, 4, 5], [1, 3, 4, 5])] = self.options.covariance_factor * P[_ALIGNMENT, _ALIGNMENT]
        signals["position_sd_m"] = sqrt(float(np.trace(covariance[3:, 3:])))
        signals["distrust"] = float(self._weight @ np.log10(self._distrust))
        return Estimate(map_T_cam, Status.FUSED, covariance, map_T_vio, (), reasons, signals)

    def _raw_covariance(self) -> Array:
        """Of a prediction by itself, from the learnt scales."""
        horizontal, vertical, yaw, tilt = self._scale
        return np.diag([tilt, yaw, tilt, horizontal, vertical, horizontal])

    def _state(self) -> State:
        return {
            "scale": plain(self._scale),
            "change": plain(self._change),
            "seen": self._seen,
            "evidence": plain(self._evidence),
            "evidence_frames": self._evidence_frames,
            "error": plain(self._error),
            "x": plain(self._state_x),
            "P": plain(self._P),
            "weight": plain(self._weight),
            "vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])],
            "lost": self._lost,
        }

    def _set_state(self, state: State) -> None:
        self._forget()
        self._scale, self._change = np.array(state["scale"]), np.array(state["change"])
        self._seen, self._evidence_frames = state["seen"], state["evidence_frames"]
        self._evidence = np.array(state["evidence"])
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))
        self._lost = state["lost"]
        if state["x"] is not None:
            self._error, self._state_x = np.array(state["error"]), np.array(state["x"])
            self._P, self._weight = np.array(state["P"]), np.array(state["weight"])


def _wrapped(angle: Any) -> Any:
    """Angles in radians brought to -pi..pi."""
    return (angle + pi) % (2 * pi) - pi
