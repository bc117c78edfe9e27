"""Method `drift_aware`: the alignment as a slowly drifting state, estimated from all the history.

Odometry and map are both gravity-aligned, so odometry drifts in yaw and position only. A Kalman filter carries the
camera's map position and the yaw between the frames, and beside them the regressor's bias at this place, which
fades as the camera moves on: neighbouring predictions share their error, and counting them as independent would
make the filter far too sure.

How wrong predictions are is learnt as the walk goes on, for the walk as a whole and for the place: a prediction is a
bad one whose gravity disagrees with odometry's, whose height disagrees with the one that is well known by then, or
whose error changes fast. That shows within one frame and needs no threshold in metres. What still doesn't fit has the
tails of Student's t. Several filters that believe odometry less and less run side by side and share their states by how
well they predict (interacting multiple models, Blom and Bar-Shalom 1988), so that bad odometry is answered by following
the regressor.
"""

from math import acos, atan2, cos, exp, pi, radians, sin, sqrt

import numpy as np
from pydantic import Field

from fusion.localiser import Estimate, Localiser, State, Status, plain
from fusion.odometry import OdometryOptions
from geometry.poses import Array

# The state of each filter: yaw of map_R_vio and the camera's map position, then the regressor's bias in these four,
# in units of its local standard deviation.
_ALIGNMENT, _BIAS = slice(0, 4), slice(4, 8)
_I4, _I8 = np.arange(4), np.arange(8)
# Learnt variances.
_HORIZONTAL, _VERTICAL, _YAW, _TILT = range(4)
# Tilt and height are known to be errors of the prediction, whatever the alignment is: they count double.
_SURE = 2.0
_LEAST = [1e-3, 1e-4, 1e-6, radians(0.3) ** 2]


class DriftAwareOptions(OdometryOptions):
    """What the filter assumes of odometry and of the regressor before it has seen them."""

    position_sd_m: float = Field(1.5, gt=0, description="a prediction's first assumed error a horizontal axis")
    yaw_sd_deg: float = Field(5.0, gt=0, description="a prediction's first assumed yaw error, and tilt error an axis")
    first_factor: float = Field(10.0, ge=1, description="how much larger the variance of the very first is assumed")
    memory_frames: float = Field(80.0, gt=1, description="predictions over which the scales of errors are learnt")
    prior_frames: float = Field(4.0, gt=0, description="predictions that the first assumptions count as")
    bias: bool = Field(True, description="model the error that neighbouring predictions share")
    bias_length_m: float = Field(4.0, gt=0, description="motion over which the shared error fades to 1/e")
    turn_length_m: float = Field(2.0, ge=0, description="motion that a turn by one radian counts as")
    noise_share: float = Field(0.5, gt=0, le=1, description="share of a prediction's variance that isn't shared")
    local_scale: bool = Field(True, description="learn how wrong predictions are here, from what shows in one frame")
    tilt: bool = Field(True, description="use the angle between the prediction's gravity and odometry's")
    height: bool = Field(True, description="use the prediction's height: odometry hardly drifts in it")
    cross: float = Field(0.2, ge=0, le=1, description="weight of rotation's evidence on position's scale, and back")
    place_decay: float = Field(0.6, gt=0, lt=1, description="what is left of local evidence after a metre")
    degrees_of_freedom: float = Field(3.0, gt=0, description="of Student's t, the tails of what still doesn't fit")
    drift_m: float = Field(0.03, gt=0, description="odometry's drift over one metre, one sigma, as a random walk")
    drift_height_m: float = Field(0.015, gt=0, description="the same, of height")
    drift_deg_m: float = Field(0.5, gt=0, description="odometry's yaw drift over one metre, one sigma")
    drift_deg_s: float = Field(0.05, gt=0, description="odometry's yaw drift over one second, one sigma")
    distrust: list[float] = Field([1.0, 10.0, 100.0, 1000.0], min_length=1, description="drift variances tried")
    switch: float = Field(0.001, gt=0, lt=0.5, description="probability a frame that odometry's quality changes")
    evidence: float = Field(0.2, gt=0, le=1, description="how much a prediction counts in judging odometry's quality")
    tilt_sd_deg: float = Field(0.3, gt=0, description="odometry's gravity error an axis")
    covariance_factor: float = Field(2.0, gt=0, description="what the filter's covariance is multiplied with")


class DriftAware(Localiser):
    """The filter. Every frame from the first prediction on gets a pose and a covariance."""

    def __init__(self, options: DriftAwareOptions | None = None) -> None:
        super().__init__()
        self.options = o = options or DriftAwareOptions()
        levels = len(o.distrust)
        self._distrust = np.array(o.distrust)
        self._log_distrust = np.log10(self._distrust)
        # Odometry's quality changes to a neighbouring level.
        stay = np.eye(levels)
        near = (np.abs(np.subtract.outer(np.arange(levels), np.arange(levels))) == 1) if levels > 1 else stay
        self._switching = (1 - o.switch) * stay + o.switch * near / near.sum(1, keepdims=True)
        # What a metre and a second add to the variances of yaw and position, at each level (L, 4).
        yaw_m, yaw_s = radians(o.drift_deg_m) ** 2, radians(o.drift_deg_s) ** 2
        position, height = o.drift_m**2, o.drift_height_m**2
        self._a_metre = self._distrust[:, None] * np.array([yaw_m, position, height, position])
        # Standing still drifts a little too.
        self._a_second = self._distrust[:, None] * np.array([yaw_s, 0.05 * position, 0.05 * height, 0.05 * position])
        self._forget()

    def _forget(self) -> None:
        o = self.options
        position, angle = o.position_sd_m**2, radians(o.yaw_sd_deg) ** 2
        # Learnt variances of predictions, typical over the walk; of their change from one to the next.
        self._scale = [position, position / 4, angle, angle]
        self._change = [position, angle]
        self._seen = o.prior_frames
        self._evidence = [0.0, 0.0, 0.0, 0.0]  # at this place: tilt, position change, yaw change, height
        self._evidence_frames = 0.0
        self._error: list[float] | None = None  # of the last prediction (yaw, x, y, z), as the filters saw it
        self._x: Array | None = None  # (L, 8), L levels of distrust
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
        if self._x is not None:
            moved, jumped = self._predict(t_ns, vio_T_cam)
            reasons = ("odometry_jump",) if jumped else ()
        self._vio, self._lost = (t_ns, vio_T_cam), False
        if map_T_cam_apr is None:
            if self._x is None:
                return Estimate(None, Status.NONE, reasons=("no_prediction",))
            return self._estimate(vio_T_cam, *self._mean(), (*reasons, "no_prediction"), {})
        offset = map_T_cam_apr[:3, :3] @ vio_T_cam[:3, :3].T
        yaw = atan2(offset[0, 2] - offset[2, 0], offset[0, 0] + offset[2, 2])
        measured = np.array([yaw, *map_T_cam_apr[:3, 3]])
        down = -vio_T_cam[1, :3] if gravity is None else gravity
        tilt = acos(min(1.0, max(-1.0, float(-map_T_cam_apr[1, :3] @ down))))
        if self._x is None:
            self._begin(measured, tilt)
            return self._estimate(vio_T_cam, *self._mean(), ("first_prediction",), {"tilt_deg": tilt * 180 / pi})
        signals = {"tilt_deg": tilt * 180 / pi}
        local = self._correct(measured, tilt, moved, signals)
        x, P = self._mean()
        self._learn(measured, x, P, local)
        return self._estimate(vio_T_cam, x, P, reasons, signals)

    def _begin(self, measured: Array, tilt: float) -> None:
        """The first prediction is all there is: the state is what it says, as uncertain as it is."""
        o, levels = self.options, len(self._distrust)
        self._error = [0.0] * 4
        tilts = tilt * tilt / self._scale[_TILT] if o.tilt else 2.0
        self._evidence, self._evidence_frames = [tilts, 2.0, 1.0, 1.0], 1.0
        position = (1 + o.cross * tilts) / (1 + 2 * o.cross) if o.local_scale else 1.0
        angle = (1 + tilts) / 3 if o.local_scale else 1.0
        variance = o.first_factor * self._variances(position, angle)
        P = np.zeros((8, 8))
        P[_I4, _I4] = variance
        P[_I4 + 4, _I4 + 4] = 1.0
        if o.bias:
            P[_I4, _I4 + 4] = P[_I4 + 4, _I4] = -np.sqrt((1 - o.noise_share) * variance)
        self._x = np.tile(np.concatenate([measured, np.zeros(4)]), (levels, 1))
        self._P = np.tile(P, (levels, 1, 1))
        weight: Array = np.power(0.1, np.arange(levels))
        self._weight = weight / weight.sum()

    def _variances(self, position: float, angle: float) -> Array:
        """The variances (4,) of a prediction's yaw and position, from how much larger than usual they are here."""
        horizontal, vertical, yaw, _ = self._scale
        return np.array([yaw * angle, horizontal * position, vertical * position, horizontal * position])

    def _predict(self, t_ns: int, vio_T_cam: Array) -> tuple[float, bool]:
        """Carry the state along odometry; returns the motion in metres (turns counted in) and whether it jumped."""
        assert self._vio is not None and self._x is not None
        o = self.options
        self._mix()
        x, P = self._x, self._P  # both are changed in place
        seconds = (t_ns - self._vio[0]) * 1e-9
        dx, dy, dz = (vio_T_cam[:3, 3] - self._vio[1][:3, 3]).tolist()
        length = sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (float(np.vdot(vio_T_cam[:3, :3], self._vio[1][:3, :3])) - 1) / 2
        moved = length + o.turn_length_m * acos(min(1.0, max(-1.0, cosine)))
        jumped = length > o.vio_speed_m_s * seconds + o.vio_jump_m

        c, s = np.cos(x[:, 0]), np.sin(x[:, 0])
        east, north = c * dx + s * dz, c * dz - s * dx
        x[:, 1] += east
        x[:, 2] += dy
        x[:, 3] += north
        kept = exp(-moved / o.bias_length_m)
        x[:, _BIAS] *= kept
        # F P F^T by rows and columns: yaw turns the step, the bias fades.
        P[:, 1] += north[:, None] * P[:, 0]
        P[:, 3] -= east[:, None] * P[:, 0]
        P[:, :, 1] += north[:, None] * P[:, :, 0]
        P[:, :, 3] -= east[:, None] * P[:, :, 0]
        P[:, _BIAS] *= kept
        P[:, :, _BIAS] *= kept
        drift = length * self._a_metre + seconds * self._a_second
        if jumped or self._lost:
            # Where odometry went unwatched, it may have lost the fastest walk, and its heading.
            far = length**2 + (o.vio_speed_m_s * seconds) ** 2
            drift = drift + np.array([radians(20.0) ** 2, far, far, far])
        diagonal = np.einsum("lii->li", P)
        diagonal[:, _ALIGNMENT] += drift
        diagonal[:, _BIAS] += 1 - kept**2
        return moved, jumped

    def _mix(self) -> None:
        """Share the levels' states by how probably odometry has changed from one to the other."""
        assert self._x is not None
        levels = len(self._weight)
        if levels == 1:
            return
        joint = self._switching * self._weight[:, None]
        weight = joint.sum(axis=0)
        share = (joint / weight).T  # (to, from)
        x = share @ self._x
        apart = self._x[None] - x[:, None]
        spread = (share[:, :, None] * apart).transpose(0, 2, 1) @ apart
        self._P = (share @ self._P.reshape(levels, 64)).reshape(levels, 8, 8) + spread
        self._x, self._weight = x, weight

    def _correct(self, measured: Array, tilt: float, moved: float, signals: dict[str, float]) -> tuple[float, float]:
        """Take in a prediction; returns how much larger than usual variances of position and angle are here."""
        assert self._x is not None
        o, x, P = self.options, self._x, self._P
        error = measured - x[:, _ALIGNMENT]  # (L, 4)
        error[:, 0] = (error[:, 0] + pi) % (2 * pi) - pi
        local = self._local_scale((self._weight @ error).tolist(), tilt, moved)
        variance = self._variances(*local)
        share = o.noise_share if o.bias else 1.0

        def innovation(variance: Array) -> tuple[Array, Array, Array]:
            h = np.sqrt((1 - share) * variance)
            HP = P[:, _ALIGNMENT] + h[:, None] * P[:, _BIAS]
            S = HP[:, :, _ALIGNMENT] + HP[:, :, _BIAS] * h
            np.einsum("lii->li", S)[:] += share * variance
            inverse = np.asarray(np.linalg.inv(S), dtype=float)
            return error - h * x[:, _BIAS], HP, inverse

        r, HP, inverse = innovation(variance)
        d2 = ((r[:, None] @ inverse)[:, 0] * r).sum(axis=1)
        nu = o.degrees_of_freedom
        log_likelihood = -(nu + 4) / 2 * np.log1p(d2 / nu) + np.log(np.linalg.det(inverse)) / 2
        # Errors that the model takes for independent aren't quite, so a frame counts as less evidence than it looks.
        posterior = self._weight * np.exp(o.evidence * (log_likelihood - log_likelihood.max()))
        weight = np.maximum(posterior / posterior.sum(), 1e-6)
        self._weight = weight / weight.sum()
        surprise = float(self._weight @ d2)
        trust = min(1.0, (nu + 4) / (nu + surprise))
        if trust < 1:
            r, HP, inverse = innovation(variance / trust)
        K = HP.transpose(0, 2, 1) @ inverse
        x += (K @ r[:, :, None])[:, :, 0]
        x[:, 0] = x[0, 0] + (x[:, 0] - x[0, 0] + pi) % (2 * pi) - pi
        P = P - K @ HP
        self._P = (P + P.transpose(0, 2, 1)) / 2
        signals |= {"surprise": surprise, "local_scale": sqrt(local[0]), "trust": trust}
        return local

    def _local_scale(self, error: list[float], tilt: float, moved: float) -> tuple[float, float]:
        """How much larger than usual the variances of position and angle are at this place.

        Evidence: the tilt (two axes), the height, and how much the error changed since the last prediction: all known
        whatever the alignment is. It fades as the camera moves on.
        """
        o = self.options
        assert self._error is not None
        yaw, x, y, z = error
        turned = _wrapped(yaw - self._error[0])
        changed = ((x - self._error[1]) ** 2 + (z - self._error[3]) ** 2) / 2
        fresh = (tilt**2 / 2 if o.tilt else self._scale[_TILT], changed, turned**2)
        typical = (self._scale[_TILT], *self._change)
        relative = [f / t for f, t in zip(fresh, typical, strict=True)]
        height = y**2 / (self._scale[_VERTICAL] + float(self._weight @ self._P[:, 2, 2]))
        kept = o.place_decay**moved
        counts = (2 * relative[0], 2 * relative[1], relative[2], height)
        self._evidence = [kept * before + now for before, now in zip(self._evidence, counts, strict=True)]
        self._evidence_frames = kept * self._evidence_frames + 1
        # What is typical is learnt as a t distribution's scale, which bad predictions hardly move.
        rate = 1 / (self._seen + 1)
        nu = o.degrees_of_freedom
        tilt_variance, *self._change = (
            max((1 - rate) * t + rate * f * (nu + 2) / (nu + 2 * q), least)
            for t, f, q, least in zip(typical, fresh, relative, (_LEAST[_TILT], 1e-4, 1e-6), strict=True)
        )
        self._scale[_TILT] = tilt_variance
        if not o.local_scale:
            return 1.0, 1.0
        tilts, positions, yaws, heights = self._evidence
        n, sure = self._evidence_frames, _SURE if o.height else 0.0
        positions += sure * heights
        position = (nu + positions + o.cross * tilts) / (nu + (2 + sure) * n + o.cross * 2 * n)
        angle = (nu + _SURE * tilts + yaws + o.cross * positions) / (
            nu + (2 * _SURE + 1) * n + o.cross * (2 + sure) * n
        )
        return position, angle

    def _learn(self, measured: Array, x: Array, P: Array, local: tuple[float, float]) -> None:
        """Update the predictions' typical variances from what the corrected alignment leaves over."""
        error = (measured - x[_ALIGNMENT]).tolist()
        error[0] = _wrapped(error[0])
        self._error = error
        yaw, east, up, north = (e * e + p for e, p in zip(error, P.diagonal()[:4].tolist(), strict=True))
        position, angle = local
        rate, nu = 1 / (self._seen + 1), self.options.degrees_of_freedom
        for which, left, place in (
            (_HORIZONTAL, (east + north) / 2, position),
            (_VERTICAL, up, position),
            (_YAW, yaw, angle),
        ):
            here = left / place
            weight = (nu + 1) / (nu + here / self._scale[which])
            self._scale[which] = max((1 - rate) * self._scale[which] + rate * here * weight, _LEAST[which])
        self._seen = min(self._seen + 1, self.options.memory_frames)

    def _mean(self) -> tuple[Array, Array]:
        """The levels' mean state (8,) and covariance (8, 8)."""
        assert self._x is not None
        x = self._weight @ self._x
        apart = self._x - x
        P = (self._weight @ self._P.reshape(len(self._weight), 64)).reshape(8, 8)
        return x, P + (self._weight * apart.T) @ apart

    def _estimate(
        self, vio_T_cam: Array, x: Array, P: Array, reasons: tuple[str, ...], signals: dict[str, float]
    ) -> Estimate:
        c, s = cos(x[0]), sin(x[0])
        map_T_vio = np.array([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 0.0], [0.0, 0.0, 0.0, 1.0]])
        map_T_cam = map_T_vio @ vio_T_cam
        map_T_vio[:3, 3] = x[1:4] - map_T_cam[:3, 3]
        map_T_cam[:3, 3] = x[1:4]
        covariance = np.zeros((6, 6))
        covariance[0, 0] = covariance[2, 2] = radians(self.options.tilt_sd_deg) ** 2
        block = self.options.covariance_factor * P[_ALIGNMENT, _ALIGNMENT]
        covariance[1, 1] = block[0, 0]
        covariance[1, 3:] = covariance[3:, 1] = block[0, 1:]
        covariance[3:, 3:] = block[1:, 1:]
        signals["position_sd_m"] = sqrt(block[1, 1] + block[2, 2] + block[3, 3])
        signals["distrust"] = float(self._weight @ self._log_distrust)
        return Estimate(map_T_cam, Status.FUSED, covariance, map_T_vio, (), reasons, signals)

    def _raw_covariance(self) -> Array:
        """Of a prediction by itself, from the learnt scales."""
        horizontal, vertical, yaw, tilt = self._scale
        return np.diag([tilt, yaw, tilt, horizontal, vertical, horizontal])

    def _state(self) -> State:
        return {
            "scale": list(self._scale),
            "change": list(self._change),
            "seen": self._seen,
            "evidence": list(self._evidence),
            "evidence_frames": self._evidence_frames,
            "error": self._error,
            "x": plain(self._x),
            "P": plain(self._P),
            "weight": plain(self._weight),
            "vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])],
            "lost": self._lost,
        }

    def _set_state(self, state: State) -> None:
        self._forget()
        self._scale, self._change = list(state["scale"]), list(state["change"])
        self._seen, self._evidence_frames = state["seen"], state["evidence_frames"]
        self._evidence, self._error = list(state["evidence"]), state["error"]
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))
        self._lost = state["lost"]
        if state["x"] is not None:
            self._x, self._P = np.array(state["x"]), np.array(state["P"])
            self._weight = np.array(state["weight"])


def _wrapped(angle: float) -> float:
    """An angle in radians brought to -pi..pi."""
    return (angle + pi) % (2 * pi) - pi
