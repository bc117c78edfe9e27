"""Method `drift_aware`: the alignment as a slowly drifting state, estimated from all the history.

Odometry and map are both gravity-aligned, so odometry drifts in yaw and position only. A Kalman filter carries the
camera's map position and the yaw between the frames, and beside them the regressor's bias at this place, which
fades as the camera moves on: neighbouring predictions share their error, and counting them as independent would
make the filter far too sure.

How wrong predictions are is known beforehand where frames were held out of the regressor's training (`ErrorMap`), and
learnt as the walk goes on, for the walk as a whole and for the place: a prediction is a bad one whose gravity disagrees
with odometry's, whose height disagrees with the one that is well known by then, or whose error changes fast. That shows
within one frame and needs no threshold in metres. What still doesn't fit has the tails of Student's t. Several filters
that believe odometry less and less, the last of them not at all, run side by side and share their states by how well
they predict (interacting multiple models, Blom and Bar-Shalom 1988), so that bad odometry is answered by following the
regressor, and a jump by aligning anew. Odometry keeps its gravity through all of that, so a prediction that leans tells
little of it.
"""

from math import acos, atan2, cos, exp, lgamma, log, pi, radians, sin, sqrt

import numpy as np
from pydantic import Field

from groundwalk.fusion.error_map import ErrorMap, Expected
from groundwalk.fusion.localiser import Estimate, Localiser, State, Status, plain
from groundwalk.fusion.odometry import OdometryOptions
from groundwalk.geometry.poses import Array

# The state of each filter: yaw of map_R_vio and the camera's map position, then the regressor's bias in these four,
# in units of its local standard deviation.
_ALIGNMENT, _BIAS = slice(0, 4), slice(4, 8)
# Learnt factors of variances, by kind of error.
_HORIZONTAL, _VERTICAL, _YAW, _TILT = range(4)
# Tilt and height are known to be errors of the prediction, whatever the alignment is: they count double.
_SURE = 2.0
_LEAST = 1e-3
# Filters of a level of distrust go on at it; one whose odometry has lost its frame mostly finds it again at once.
_STAY_LOST = 0.2
_LOST_M, _LOST_HEIGHT_M, _LOST_DEG = 10.0, 3.0, 60.0
_ANYWHERE_DENSITY = 1 / (2 * pi * 40.0**2 * _LOST_HEIGHT_M)  # of predictions that are anywhere on a map of 40 m


class DriftAwareOptions(OdometryOptions):
    """What the filter assumes of odometry and of the regressor before it has seen them."""

    position_sd_m: float = Field(
        1.5, gt=0, description="a prediction's first assumed error a horizontal axis, where no frames were held out"
    )
    yaw_sd_deg: float = Field(5.0, gt=0, description="a prediction's first assumed yaw error, and tilt error an axis")
    first_factor: float = Field(10.0, ge=1, description="how much larger the variance of the very first is assumed")
    memory_frames: float = Field(80.0, gt=1, description="predictions over which the scales of errors are learnt")
    prior_frames: float = Field(4.0, gt=0, description="predictions that the first assumptions count as")
    error_map: bool = Field(True, description="use what held-out frames tell of the regressor's errors")
    side_yaw: bool = Field(True, description="use that an error to the side comes with a yaw error, as the map tells")
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
    lost: bool = Field(True, description="also try that odometry has lost its frame, so that it tells nothing")
    evidence: float = Field(0.5, gt=0, le=1, description="how much a prediction counts in judging odometry's quality")
    outliers: float = Field(0.1, gt=0, lt=1, description="share of predictions that may be anywhere on the map")
    outlier_runs: float = Field(
        0.67, ge=0, lt=1, description="share of such predictions after one: a look aside takes some seconds"
    )
    switch: float = Field(5e-4, gt=0, lt=0.5, description="probability a frame that odometry's quality changes")
    tilt_sd_deg: float = Field(0.3, gt=0, description="odometry's gravity error an axis")
    covariance_factor: float = Field(
        2.0, gt=0, description="what the filter's covariance of position is multiplied with"
    )
    yaw_covariance_factor: float = Field(0.8, gt=0, description="the same, of yaw")


class DriftAware(Localiser):
    """The filter. Every frame from the first prediction on gets a pose and a covariance."""

    def __init__(self, options: DriftAwareOptions | None = None, error_map: ErrorMap | None = None) -> None:
        super().__init__()
        self.options = o = options or DriftAwareOptions()
        self._error_map = error_map if o.error_map else None
        sds = np.array([radians(o.yaw_sd_deg), o.position_sd_m, o.position_sd_m / 2, o.position_sd_m])
        share = o.noise_share if o.bias else 1.0
        self._usual = Expected(np.zeros(4), (1 - share) * sds**2, share * sds**2, radians(o.yaw_sd_deg) ** 2)
        levels = len(o.distrust) + o.lost
        self._distrust = np.array([*o.distrust, *[10 * o.distrust[-1]] * o.lost])
        self._log_distrust = np.log10(self._distrust)
        # Odometry's quality may change from one frame to the next, to any other.
        self._switching = np.full((levels, levels), o.switch / max(levels - 1, 1))
        np.fill_diagonal(self._switching, 1 - o.switch)
        if o.lost:
            self._switching[-1] = (1 - _STAY_LOST) / (levels - 1)
            self._switching[-1, -1] = _STAY_LOST
        # After a jump, or where odometry was gone for a while, it's as likely to have a new frame as the old one.
        self._switching_watched = self._switching.copy()
        if o.lost:
            self._switching_watched /= 2
            self._switching_watched[:, -1] += 0.5
        # What a metre, a second and the fading of the bias add to the variances of the state, at each level (3, L * 8).
        yaw_m, yaw_s = radians(o.drift_deg_m) ** 2, radians(o.drift_deg_s) ** 2
        position, height = o.drift_m**2, o.drift_height_m**2
        a_metre = [yaw_m, position, height, position]
        # Standing still drifts a little too.
        a_second = [yaw_s, 0.05 * position, 0.05 * height, 0.05 * position]
        added = np.zeros((3, levels, 8))
        added[0, :, _ALIGNMENT] = self._distrust[:, None] * a_metre
        added[1, :, _ALIGNMENT] = self._distrust[:, None] * a_second
        added[2, :, _BIAS] = 1.0
        self._added = added.reshape(3, -1)
        self._usual_drift = [(yaw_m, yaw_s), (position, 0.05 * position)]
        # Odometry's step and the measurement as matrices, of which a step changes some numbers.
        self._factor_rows = np.ones((levels, 4))
        self._F, self._H = np.tile(np.eye(8), (levels, 1, 1)), np.tile(np.eye(4, 8), (levels, 1, 1))
        # What is thought of the alignment where odometry may have lost its frame, whenever a prediction can tell.
        self._anywhere = np.zeros((levels, 4))
        if o.lost:
            self._anywhere[-1] = np.square([radians(_LOST_DEG), _LOST_M, _LOST_HEIGHT_M, _LOST_M])
        # Normalisation of Student's t in four dimensions.
        nu = o.degrees_of_freedom
        self._t_density = exp(lgamma((nu + 4) / 2) - lgamma(nu / 2) - 2 * log(nu * pi))
        widened = np.sqrt([o.yaw_covariance_factor, *[o.covariance_factor] * 3])
        self._widened = np.outer(widened, widened)
        self._tilt_variance = radians(o.tilt_sd_deg) ** 2
        self._forget()

    def _forget(self) -> None:
        o = self.options
        # Learnt factors of predictions' variances over the walk, and of their change from one to the next.
        self._scale = [1.0, 1.0, 1.0, 1.0]
        self._change = [1.0, 1.0]
        self._seen = o.prior_frames
        self._evidence = [0.0, 0.0, 0.0, 0.0]  # at this place: tilt, position change, yaw change, height
        self._evidence_frames = 0.0
        self._error: list[float] | None = None  # of the last prediction (yaw, x, y, z), as the filters saw it
        self._x: Array | None = None  # (L, 8), L levels of distrust
        self._P = np.zeros((0, 8, 8))
        self._weight = np.zeros(0)
        self._wrong = np.zeros(0)  # at each level: the probability that the last prediction was anywhere
        self._vio: tuple[int, Array] | None = None
        self._lost = False
        self._afresh()

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if vio_T_cam is None:
            self._lost = self._vio is not None
            if map_T_cam_apr is None:
                return Estimate(None, Status.NONE, reasons=("no_odometry", "no_prediction"))
            return self._raw(map_T_cam_apr)
        reasons: tuple[str, ...] = ()
        if self._x is not None and self._predict(t_ns, vio_T_cam):
            reasons = ("odometry_jump",)
        self._vio, self._lost = (t_ns, vio_T_cam), False
        if map_T_cam_apr is None:
            if self._x is None:
                return Estimate(None, Status.NONE, reasons=("no_prediction",))
            return self._estimate(vio_T_cam, *self._mean(), (*reasons, "no_prediction"), {})
        apr, vio = map_T_cam_apr.tolist(), vio_T_cam.tolist()
        yaw = atan2(_dot(apr[0], vio[2]) - _dot(apr[2], vio[0]), _dot(apr[0], vio[0]) + _dot(apr[2], vio[2]))
        expected = self._expected(map_T_cam_apr)
        measured = np.array([yaw, apr[0][3], apr[1][3], apr[2][3]]) - expected.error
        upright = _dot(apr[1], vio[1]) if gravity is None else -_dot(apr[1], gravity.tolist())
        tilt = acos(min(1.0, max(-1.0, upright)))
        if self._x is None:
            self._begin(measured, tilt, expected)
            return self._estimate(vio_T_cam, *self._mean(), ("first_prediction",), {"tilt_deg": tilt * 180 / pi})
        signals = {"tilt_deg": tilt * 180 / pi}
        local = self._correct(measured, tilt, signals, expected)
        x, P = self._mean()
        self._learn(measured, x, P, local, expected)
        self._afresh()
        return self._estimate(vio_T_cam, x, P, reasons, signals)

    def _afresh(self) -> None:
        """A prediction has been taken in: what is counted since the last one begins anew."""
        self._moved = 0.0  # metres, turns counted in
        self._strayed = [0.0, 0.0]  # variance that odometry is thought to have added to yaw and to position
        self._mixed = False  # odometry's quality may change once between two predictions

    def _expected(self, map_T_cam_apr: Array) -> Expected:
        """What is known of a prediction's error before the walk."""
        if self._error_map is None:
            return self._usual
        expected = self._error_map.expected(map_T_cam_apr[:3, 3], map_T_cam_apr[:3, 2])
        if not self.options.side_yaw:
            expected = expected.by_themselves()
        if not self.options.bias:
            expected = expected._replace(shared=np.zeros(4), noise=expected.shared + expected.noise)
        return expected

    def _begin(self, measured: Array, tilt: float, expected: Expected) -> None:
        """The first prediction is all there is: the state is what it says, as uncertain as it is."""
        o, levels = self.options, len(self._distrust)
        self._error = [0.0] * 4
        tilts = self._tilts(tilt, expected.tilt)
        self._evidence, self._evidence_frames = [tilts, 2.0, 1.0, 1.0], 1.0
        position = (1 + o.cross * tilts) / (1 + 2 * o.cross) if o.local_scale else 1.0
        angle = (1 + tilts) / 3 if o.local_scale else 1.0
        factor = o.first_factor * np.array(self._factors(position, angle))
        coupled = np.eye(4)
        coupled[0, 1::2] = expected.yaw_per_m
        P = np.eye(8)
        P[_ALIGNMENT, _ALIGNMENT] = coupled * (factor * (expected.shared + expected.noise)) @ coupled.T
        P[_ALIGNMENT, _BIAS] = -coupled * np.sqrt(factor * expected.shared)
        P[_BIAS, _ALIGNMENT] = P[_ALIGNMENT, _BIAS].T
        self._x = np.tile(np.concatenate([measured, np.zeros(4)]), (levels, 1))
        self._P = np.tile(P, (levels, 1, 1))
        weight: Array = np.power(0.1, np.arange(levels))
        self._weight = weight / weight.sum()
        self._wrong = np.zeros(levels)

    def _tilts(self, tilt: float, usual: float) -> float:
        """Squared tilt (rad) over its typical variance, both axes together: 2 is typical."""
        return tilt * tilt / (usual * self._scale[_TILT]) if self.options.tilt else 2.0

    def _factors(self, position: float, angle: float) -> list[float]:
        """How much larger than expected the variances of yaw and position are, here and in this walk."""
        horizontal, vertical, yaw, _ = self._scale
        return [yaw * angle, horizontal * position, vertical * position, horizontal * position]

    def _predict(self, t_ns: int, vio_T_cam: Array) -> bool:
        """Carry the state along odometry; returns whether it jumped."""
        assert self._vio is not None and self._x is not None
        o = self.options
        seconds = (t_ns - self._vio[0]) * 1e-9
        now, last = vio_T_cam.tolist(), self._vio[1].tolist()
        dx, dy, dz = (now[i][3] - last[i][3] for i in range(3))
        length = sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (_dot(now[0], last[0]) + _dot(now[1], last[1]) + _dot(now[2], last[2]) - 1) / 2
        moved = length + o.turn_length_m * acos(min(1.0, max(-1.0, cosine)))
        jumped = length > o.vio_speed_m_s * seconds + o.vio_jump_m

        watched, believed = jumped or self._lost, self._weight
        if watched or not self._mixed:
            self._mix(self._switching_watched if watched else self._switching)
            self._mixed = True
        x, F = self._x, self._F
        # The horizontal step, turned by each level's yaw.
        turned = np.exp(-1j * x[:, 0]) * complex(dx, dz)
        east, north = turned.real, turned.imag
        kept = exp(-moved / o.bias_length_m)
        x[:, 1] += east
        x[:, 2] += dy
        x[:, 3] += north
        x[:, _BIAS] *= kept
        F[:, 1, 0], F[:, 3, 0] = north, -east
        F.reshape(-1, 64)[:, 36::9] = kept
        self._P = P = F @ self._P @ F.transpose(0, 2, 1)
        diagonal = P.reshape(-1, 64)[:, ::9]  # a view
        diagonal += (np.array([length, seconds, 1 - kept * kept]) @ self._added).reshape(-1, 8)
        distrust = float(believed @ self._distrust)
        added = [distrust * (length * a_metre + seconds * a_second) for a_metre, a_second in self._usual_drift]
        if watched:
            diagonal[:, _ALIGNMENT] += self._anywhere
            added = [a + b for a, b in zip(added, (believed @ self._anywhere)[:2].tolist(), strict=True)]
        self._strayed = [a + b for a, b in zip(self._strayed, added, strict=True)]
        self._moved += moved
        return jumped

    def _mix(self, switching: Array) -> None:
        """Share the levels' states by how probably odometry has changed from one to the other."""
        assert self._x is not None
        levels = len(self._weight)
        if levels == 1:
            return
        weight = self._weight @ switching
        share = (switching * self._weight[:, None] / weight).T  # (to, from)
        x = share @ self._x
        apart = self._x - x[:, None]
        spread = (share[:, :, None] * apart).transpose(0, 2, 1) @ apart
        spread += (share @ self._P.reshape(levels, 64)).reshape(levels, 8, 8)
        self._x, self._P, self._weight, self._wrong = x, spread, weight, share @ self._wrong

    def _correct(
        self, measured: Array, tilt: float, signals: dict[str, float], expected: Expected
    ) -> tuple[float, float]:
        """Take in a prediction; returns how much larger than expected variances of position and angle are here."""
        assert self._x is not None
        o, x, P, H = self.options, self._x, self._P, self._H
        P.reshape(-1, 64)[:, :32:9] += self._anywhere
        error = _uncoupled(measured - self._weight @ x[:, _ALIGNMENT], expected)
        usual = (expected.shared + expected.noise).tolist()
        local = self._local_scale(error, tilt, usual, expected.tilt)
        position, angle = local
        # Where odometry is as good as usual, what doesn't fit is the predictions' fault, whose scale is learnt from it;
        # where it's worse, they are no worse than was known beforehand. Else each could be blamed for the other.
        y, horizontal, vertical, _ = blamed = self._factors(position, angle)
        known = min(y, angle), min(horizontal, position), min(vertical, position), min(horizontal, position)
        factors = self._factor_rows
        factors[0], factors[1:] = blamed, known
        shared, noise = factors * expected.shared, factors * expected.noise
        # An error to the side comes with one of yaw: yaw is measured less what the position's error says of it.
        per_x, per_z = expected.yaw_per_m
        H.reshape(-1, 32)[:, 4::9] = sds = np.sqrt(shared)
        H[:, 0, 1], H[:, 0, 3] = -per_x, -per_z
        HP = H @ P
        S = HP @ H.transpose(0, 2, 1)
        diagonal = S.reshape(-1, 16)[:, ::5]  # a view
        diagonal += noise
        r = measured - x[:, _ALIGNMENT]
        _wrap_about(0.0, r[:, 0])
        r[:, 0] -= per_x * r[:, 1] + per_z * r[:, 3]
        r -= sds * x[:, _BIAS]
        inverse = np.asarray(np.linalg.inv(S), dtype=float)
        weighted = inverse @ r[:, :, None]
        squares = (r[:, None] @ weighted).ravel().tolist()
        nu = o.degrees_of_freedom
        # Errors that the model takes for independent aren't quite, so a frame counts as less evidence than it looks. A
        # prediction that may be anywhere says nothing of odometry: a few of them are no reason to distrust it.
        # Such predictions come in runs. One that leans is a bad one whatever odometry has done, and so no judge of it.
        evidence = o.evidence * min(1.0, (nu + 2) / (nu + self._tilts(tilt, expected.tilt)))
        posterior, wrong = [], []
        numbers = (self._weight, self._wrong, np.linalg.det(inverse))
        for w, q, det, d2 in zip(*(n.tolist() for n in numbers), squares, strict=True):
            fits = self._t_density * sqrt(det) * (1 + d2 / nu) ** (-(nu + 4) / 2)
            share = (1 - q) * o.outliers + q * o.outlier_runs
            right, elsewhere = (1 - share) * fits, share * _ANYWHERE_DENSITY
            posterior.append(w * (right + elsewhere) ** evidence)
            wrong.append(elsewhere / (right + elsewhere))
        self._wrong = np.array(wrong)
        total = sum(posterior)
        weights = [max(p / total, 1e-6) for p in posterior]
        self._weight = np.array(weights)
        self._weight /= sum(weights)
        surprise = float(self._weight @ squares)
        trust = min(1.0, (nu + 4) / (nu + surprise))
        if trust < 1:  # the tails: what doesn't fit is this prediction's own noise
            diagonal += (1 / trust - 1) * (noise + shared)
            inverse = np.asarray(np.linalg.inv(S), dtype=float)
            weighted = inverse @ r[:, :, None]
        PH = HP.transpose(0, 2, 1)
        x += (PH @ weighted)[:, :, 0]
        _wrap_about(float(x[0, 0]), x[:, 0])
        P = P - PH @ inverse @ HP
        self._P = np.add(P, P.transpose(0, 2, 1), out=np.empty_like(P))
        self._P *= 0.5
        signals |= {"surprise": surprise, "local_scale": sqrt(position), "trust": trust}
        return local

    def _local_scale(
        self, error: list[float], tilt: float, usual: list[float], usual_tilt: float
    ) -> tuple[float, float]:
        """How much larger than usual the variances of position and angle are at this place.

        Evidence: the tilt (two axes), the height, and how much the error changed since the last prediction: all known
        whatever the alignment is. It fades as the camera moves on.
        """
        o = self.options
        assert self._error is not None
        yaw, x, y, z = error
        turned = _wrapped(yaw - self._error[0])
        changed = ((x - self._error[1]) ** 2 + (z - self._error[3]) ** 2) / 2
        typical_change, typical_turn = self._change
        tilts_now = self._tilts(tilt, usual_tilt)
        # What odometry has strayed meanwhile is no error of the prediction.
        changes = changed / usual[1] / (typical_change + self._strayed[1] / usual[1])
        turns = turned * turned / usual[0] / (typical_turn + self._strayed[0] / usual[0])
        height = y * y / (self._scale[_VERTICAL] * usual[2] + float(self._weight @ self._P[:, 2, 2]))
        kept = o.place_decay**self._moved
        counts = (tilts_now, 2 * changes, turns, height)
        tilts, positions, yaws, heights = (
            kept * before + now for before, now in zip(self._evidence, counts, strict=True)
        )
        # A prediction tells all of itself. Of the place, for the next ones, one that is far off tells no more than a t
        # distribution's weight lets it: else a single one would silence the good ones around it.
        nu = o.degrees_of_freedom
        self._evidence = [
            kept * before + now * (nu + axes) / (nu + now)
            for before, now, axes in zip(self._evidence, counts, (2, 2, 1, 1), strict=True)
        ]
        self._evidence_frames = kept * self._evidence_frames + 1
        # What is typical is learnt as a t distribution's scale, which bad predictions hardly move.
        rate = 1 / (self._seen + 1)
        self._scale[_TILT], *self._change = (
            max(t + rate * t * (q * (nu + 2) / (nu + 2 * q) - 1), _LEAST)
            for t, q in ((self._scale[_TILT], tilts_now / 2), (typical_change, changes), (typical_turn, turns))
        )
        if not o.local_scale:
            return 1.0, 1.0
        n, sure = self._evidence_frames, _SURE if o.height else 0.0
        positions += sure * heights
        position = (nu + positions + o.cross * tilts) / (nu + (2 + sure) * n + o.cross * 2 * n)
        angle = (nu + _SURE * tilts + yaws + o.cross * positions) / (
            nu + (2 * _SURE + 1) * n + o.cross * (2 + sure) * n
        )
        return position, angle

    def _learn(self, measured: Array, x: Array, P: Array, local: tuple[float, float], expected: Expected) -> None:
        """Update the predictions' typical variances from what the corrected alignment leaves over."""
        self._error = error = _uncoupled(measured - x[_ALIGNMENT], expected)
        per_x, per_z = expected.yaw_per_m
        row = P[0] - per_x * P[1] - per_z * P[3]  # of yaw less what the position's error says of it
        unsure = [row[0] - per_x * row[1] - per_z * row[3], *P.diagonal()[1:4]]
        yaw, east, up, north = (float(e * e + p) for e, p in zip(error, unsure, strict=True))
        usual = expected.shared + expected.noise
        position, angle = local
        rate, nu = float(self._weight[0]) / (self._seen + 1), self.options.degrees_of_freedom
        for which, left, place in (
            (_HORIZONTAL, (east + north) / 2 / float(usual[1]), position),
            (_VERTICAL, up / float(usual[2]), position),
            (_YAW, yaw / float(usual[0]), angle),
        ):
            here = left / place
            weight = (nu + 1) / (nu + here / self._scale[which])
            self._scale[which] = max((1 - rate) * self._scale[which] + rate * here * weight, _LEAST)
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
        yaw, x0, x1, x2, *_ = x.tolist()
        c, s = cos(yaw), sin(yaw)
        (a, b, d, v0), up, (e, f, g, v2), last = vio_T_cam.tolist()
        map_T_cam = np.array(
            [
                [c * a + s * e, c * b + s * f, c * d + s * g, x0],
                [up[0], up[1], up[2], x1],
                [c * e - s * a, c * f - s * b, c * g - s * d, x2],
                last,
            ]
        )
        shift = x0 - c * v0 - s * v2, x1 - up[3], x2 + s * v0 - c * v2
        map_T_vio = np.array([[c, 0, s, shift[0]], [0, 1, 0, shift[1]], [-s, 0, c, shift[2]], last])
        covariance = np.zeros((6, 6))
        covariance[0, 0] = covariance[2, 2] = self._tilt_variance
        block = self._widened * P[_ALIGNMENT, _ALIGNMENT]
        covariance[1, 1] = block[0, 0]
        covariance[1, 3:] = covariance[3:, 1] = block[0, 1:]
        covariance[3:, 3:] = block[1:, 1:]
        signals["position_sd_m"] = sqrt(block[1, 1] + block[2, 2] + block[3, 3])
        signals["distrust"] = float(self._weight @ self._log_distrust)
        return Estimate(map_T_cam, Status.FUSED, covariance, map_T_vio, (), reasons, signals)

    def _raw(self, map_T_cam_apr: Array) -> Estimate:
        """A prediction by itself."""
        expected = self._expected(map_T_cam_apr)
        horizontal, vertical, yaw, tilt = self._scale
        a, x, y, z = (expected.shared + expected.noise).tolist()
        t = expected.tilt * tilt
        coupled = np.eye(6)
        coupled[1, 3::2] = expected.yaw_per_m
        covariance = coupled * [t, a * yaw, t, x * horizontal, y * vertical, z * horizontal] @ coupled.T
        c, s = cos(expected.error[0]), sin(expected.error[0])
        pose = map_T_cam_apr.copy()
        pose[:3, :3] = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ pose[:3, :3]
        pose[:3, 3] -= expected.error[1:]
        return Estimate(pose, Status.PREDICTED, covariance, reasons=("no_odometry",))

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
            "wrong": plain(self._wrong),
            "vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])],
            "lost": self._lost,
            "moved": self._moved,
            "strayed": list(self._strayed),
            "mixed": self._mixed,
        }

    def _set_state(self, state: State) -> None:
        self._forget()
        self._scale, self._change = list(state["scale"]), list(state["change"])
        self._seen, self._evidence_frames = state["seen"], state["evidence_frames"]
        self._evidence, self._error = list(state["evidence"]), state["error"]
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))
        self._lost, self._moved, self._mixed = state["lost"], state["moved"], state["mixed"]
        self._strayed = list(state["strayed"])
        if state["x"] is not None:
            self._x, self._P = np.array(state["x"]), np.array(state["P"])
            self._weight, self._wrong = np.array(state["weight"]), np.array(state["wrong"])


def _uncoupled(error: Array, expected: Expected) -> list[float]:
    """Errors of yaw, x, y, z, yaw's less what comes with those of x and z."""
    yaw, x, y, z = error.tolist()
    per_x, per_z = expected.yaw_per_m
    return [_wrapped(yaw) - per_x * x - per_z * z, x, y, z]


def _dot(a: list[float], b: list[float]) -> float:
    """Of the first three numbers."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _wrap_about(middle: float, angles: Array) -> None:
    """Bring angles in radians (N,) to within pi of `middle`, in place."""
    values = angles.tolist()
    if max(values) > middle + pi or min(values) < middle - pi:
        angles[:] = [middle + _wrapped(a - middle) for a in values]


def _wrapped(angle: float) -> float:
    """An angle in radians brought to -pi..pi."""
    return (angle + pi) % (2 * pi) - pi
