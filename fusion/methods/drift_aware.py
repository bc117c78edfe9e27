"""Method `drift_aware`: the alignment as a slowly drifting state, fitted to all the evidence that is kept, again and
again.

Odometry and map are both gravity-aligned, so odometry drifts in yaw and position only. Predictions are kept as
keyframes (keyframes.py); with each new one the alignment's whole course is fitted to all of them anew
(aligner.py), so that what a prediction counts is decided in hindsight. Where the newest ones are explained
better by another alignment, odometry has lost its frame, or found it again (rivals.py)."""

from math import acos, cos, degrees, hypot, isnan, log, pi, radians, sin, sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.drift_aware_options import DriftAwareOptions
from groundwalk.fusion.methods.error_map import ErrorMap
from groundwalk.fusion.methods.estimator.aligner import (
    DIMENSIONS,
    POSITION,
    ROTATION,
    Belief,
    Fit,
    Model,
    counted,
    innovation,
    iterate,
)
from groundwalk.fusion.methods.estimator.answer import answer, leaning, rotation_into_map, yaw_and_lean
from groundwalk.fusion.methods.estimator.bounds import alignment_covariance
from groundwalk.fusion.methods.estimator.hindsight import Answered, Hindsight
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.fusion.methods.estimator.likeness import Sharing, position_variances
from groundwalk.fusion.methods.estimator.odometry_quality import OdometryQuality, expected_variances
from groundwalk.fusion.methods.estimator.prediction_noise import (
    Prior,
    shrinkage_of,
    shrunk,
    side_turn_correlation,
    sizes_expected,
    whitening,
    whitening_of_covariance,
)
from groundwalk.fusion.methods.estimator.rivals import SAME_START, SIGN, Rival, best_rival, lay, loose
from groundwalk.fusion.methods.estimator.robust import middle
from groundwalk.fusion.methods.estimator.way import CERTAIN, Way
from groundwalk.fusion.methods.localiser import Estimate, Localiser, State, Status, array, plain
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation

# Standing still drifts a little too: what a second adds to the variances, of what a metre does.
_STANDING = 0.05
_NOTHING = np.zeros(4)
_LEAST_DRIFT = np.array([1e-8, 1e-8, 1e-8, 1e-10])
_SETTLING = 20
_TILT_JITTER = radians(0.02) ** 2  # a frame's rotation is off by as much whatever is known of gravity
_WORTH_A_LOOK = 2.0  # squared error, over the usual one, of a prediction that may be of another alignment
# So many predictions in a row that are this much farther off (in the square) than usual: something is wrong.
_SURPRISES, _SURPRISING = 4, 8.0
_DOUBT = 3.0  # nats by which a rival may be behind and the alignment still be doubted


class _Extrapolation(NamedTuple):
    """What odometry makes of a keyframe for another camera: its position and yaw (4,), the keyframe's index and
    covariance (4, 4) in map axes, and what the way between both adds to the variances (4,)."""

    state: Array
    keyframe: int
    bound: Array
    added: Array


class DriftAware(Localiser):
    """Every frame from the first prediction on gets a pose and a covariance."""

    options: DriftAwareOptions

    def __init__(
        self, options: DriftAwareOptions | None = None, error_map: ErrorMap | None = None, lag_s: float = 0.0
    ) -> None:
        """`lag_s`: how old a frame that `revised` is asked for may be. Predictions up to that age are all kept."""
        super().__init__()
        self._lag_s = lag_s
        self.options = o = options or DriftAwareOptions()
        self._error_map = error_map if o.error_map else None
        self._prior = Prior(side_turn_correlation(o.side_turn), o.side_turn_count, o.size_count, o.axis_count)
        self._usual_sizes = np.repeat([radians(o.rotation_sd_deg), o.position_sd_m], 3)
        yaw_m, position, height = radians(o.drift_deg_m) ** 2, o.drift_m**2, o.drift_height_m**2
        self._drift_a_metre = np.array([position, height, position, yaw_m])
        self._drift_a_second = _STANDING * self._drift_a_metre
        self._drift_a_second[3] = radians(o.drift_deg_s) ** 2
        self._forget()

    def _forget(self) -> None:
        self._keyframes = Keyframes(self.options.keyframes, self._lag_s)
        self._covariance = self._prior.shape.copy()  # of normalised errors
        self._tilt = np.zeros(2)  # odometry's gravity error about its x and z, rad
        self._tilt_variance = radians(self.options.tilt_sd_deg) ** 2
        self._last: Fit | None = None
        self._known: Array | None = None  # the fit's own covariance of the newest keyframe's state
        self._bound: Array | None = None  # covariance (4, 4) of the newest keyframe's x, y, z and yaw, in map axes
        self._vio: tuple[int, Array] | None = None
        self._way = Way()
        self._distrust = np.ones(4)  # factors of odometry's drift variances: x, y, z, yaw
        self._quality = OdometryQuality()
        o = self.options
        self._hindsight = Hindsight(
            o.hindsight_s,
            np.array([1.0, o.yaw_covariance_factor]),
            o.hindsight_count,
            np.array([o.position_hindsight_factor, o.yaw_hindsight_factor]),
        )
        self._predicted_at_m = 0.0  # `_along_m` at the newest prediction
        self._along_m = 0.0
        self._drift = np.zeros(4)  # variances since the newest keyframe
        self._swung = [0.0, 0.0]  # covariances of x and z with the yaw since then, by steps after the yaw has drifted
        self._segment = 0
        self._count = 0  # predictions taken in since odometry's tracking was last lost
        self._watched = False  # odometry has jumped, or was gone, since the newest keyframe
        self._shrinkage: float | None = None  # of the newest prediction's covariance, if it brought one
        self._surprised = False  # something is wrong with the newest predictions, or with the alignment
        self._doubted = False  # that, or another alignment explains the newest predictions nearly as well
        self._unproven = 0  # predictions that the alignment in force must explain yet until it is believed

    # ------------------------------------------------------------ a frame

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if vio_T_cam is None:
            self._watched |= self._vio is not None
            return self._without_odometry(map_T_cam_apr)
        reasons: tuple[str, ...] = ()
        if self._vio is None:
            self._way.begin(vio_T_cam[:3, 3])
        elif self._move(t_ns, vio_T_cam):
            self._watched = True
            reasons = ("odometry_jump",)
        self._vio = (t_ns, vio_T_cam)
        if map_T_cam_apr is None:
            if not len(self._keyframes):
                return Estimate(None, Status.NONE, reasons=("no_prediction",))
            return self._estimate(vio_T_cam, (*reasons, "no_prediction"), {})
        if not len(self._keyframes):
            reasons = ("first_prediction",)
        self._take(t_ns, vio_T_cam, map_T_cam_apr)
        signals = self._fit()
        return self._estimate(vio_T_cam, reasons, signals, map_T_cam_apr if self._shrinkage is not None else None)

    def _move(self, t_ns: int, vio_T_cam: Array) -> bool:
        """Count the motion since the last frame; returns whether odometry jumped."""
        assert self._vio is not None
        o = self.options
        seconds = (t_ns - self._vio[0]) * 1e-9
        now, last = vio_T_cam.tolist(), self._vio[1].tolist()
        dx, dy, dz = (now[i][3] - last[i][3] for i in range(3))
        length = sqrt(dx * dx + dy * dy + dz * dz)
        trace = sum(now[i][k] * last[i][k] for i in range(3) for k in range(3))
        angle = acos(min(1.0, max(-1.0, (trace - 1) / 2)))
        gone = seconds > o.vio_gap_s
        turned = degrees(angle) > o.vio_turn_deg_s * seconds + o.vio_turn_jump_deg
        too_long = length > o.vio_speed_m_s * seconds + o.vio_jump_m
        jumped = turned or (too_long and self._way.is_unlike([dx, dy, dz], seconds, o.jump_m_s))
        if jumped and seconds <= o.jump_s:
            sd_deg = o.jump_deg_s * seconds if turned else 0.0
            moved = self._way.bridge(
                self._vio[1], vio_T_cam, seconds, turned, o.jump_m_s * seconds, radians(o.jump_deg + sd_deg)
            )
            self._segment += 1
            length, angle = hypot(*moved), 0.0 if turned else angle
        elif not jumped:
            self._way.go([dx, dy, dz], seconds)
            self._swing(dx, dz)
        self._along_m += length + o.turn_length_m * angle
        self._drift = self._drift + length * self._drift_a_metre + seconds * self._drift_a_second
        return jumped or gone

    def _swing(self, dx: float, dz: float) -> None:
        """Add what a step of odometry is off to the side by for how much the yaw has drifted by now."""
        yaw, (x, z) = float(self._drift[3]), self._swung
        more = dz * x - dx * z + (dx * dx + dz * dz) * yaw / 2
        self._drift = self._drift + np.array([more, 0.0, more, 0.0])
        self._swung = [x + dz * yaw, z - dx * yaw]

    def _take(self, t_ns: int, vio_T_cam: Array, map_T_cam_apr: Array) -> None:
        """Keep a prediction as the newest keyframe."""
        yaw, lean = yaw_and_lean(map_T_cam_apr[:3, :3] @ vio_T_cam[:3, :3].T)
        position = map_T_cam_apr[:3, 3]
        sizes = self._usual_sizes
        if self._error_map is not None:
            expected = self._error_map.expected(position, map_T_cam_apr[:3, 2])
            sizes = sizes_expected(expected)
            yaw -= float(expected.error[0])
            position = position - expected.error[1:]
        stated = self._apr_covariance if self.options.covariances else None
        if stated is None:
            self._shrinkage = None
            normalised = whitening(sizes, vio_T_cam[:3, :3])
        else:
            self._shrinkage = shrinkage_of(stated, (self._distrust * self._drift + _LEAST_DRIFT)[:3])
            beside_odometry = shrunk(stated, self._shrinkage) + np.diag(
                [_TILT_JITTER, 0.0, _TILT_JITTER, 0.0, 0.0, 0.0]
            )
            normalised = whitening_of_covariance(beside_odometry, map_T_cam_apr[:3, :3], vio_T_cam[:3, :3])
        state = self._carried(vio_T_cam[:3, 3]) if len(self._keyframes) else np.array([*position, yaw])
        if self.options.distrust:
            self._judge_odometry(position, yaw, normalised, state, vio_T_cam)
        bridged = self._way.loose.any()
        loss = self.options.jump_loss if bridged else 0.5 if self._watched else self.options.loss
        if self._watched and not bridged:
            self._count = 0
        self._keyframes.add(
            whitening=normalised,
            measured=(*position.tolist(), yaw, *lean),
            vio=vio_T_cam[:3, 3],
            forward=vio_T_cam[:3, 2],
            step=self._way.step(vio_T_cam[:3, 3]),
            turn=self._way.turn,
            drift=self._drift + _LEAST_DRIFT,
            loose=self._way.added,
            bridged=self._way.bridged(vio_T_cam[:3, 3]),
            moved=self._way.moved(vio_T_cam[:3, 3]),
            bridge=self._way.loose,
            odds=self._way.odds,
            state=state,
            posterior=self._keyframes.rows[-1]["posterior"] if len(self._keyframes) else 0.0,
            age=0.0,
            along=self._along_m,
            time_s=t_ns * 1e-9,
            segment=self._segment,
            rare=log((1 - loss) / loss),
        )
        self._way.begin(vio_T_cam[:3, 3])
        self._drift, self._swung, self._watched = np.zeros(4), [0.0, 0.0], False
        self._count += 1
        self._unproven -= 1

    def _judge_odometry(self, position: Array, yaw: float, normalised: Array, state: Array, vio_T_cam: Array) -> None:
        way = np.zeros(3)
        self._quality.sizes_known = self._shrinkage is not None or self._error_map is not None
        self._quality.doubtful = self._surprised
        if self._watched:
            self._quality.lost()
        elif len(self._keyframes):
            way = np.array(self._way.step(vio_T_cam[:3, 3]))
        # A yaw is measured as it was before, give or take half a turn.
        turned = state[3] + (yaw - state[3] + pi) % (2 * pi) - pi
        self._quality.update(
            np.array([*position, turned]),
            expected_variances(normalised),
            way,
            self._along_m - self._predicted_at_m,
            self._drift,
            state[3],
            1.0 if self._known is None else float(self._known[3, 3]),
        )
        self._predicted_at_m = self._along_m
        self._distrust = self._quality.factors

    def _carried(self, vio: Array, keyframe: int = -1) -> Array:
        """Position and yaw (4,) of a camera: a keyframe's, by default the newest's, moved on to odometry's position
        (3,)."""
        x, y, z, yaw = self._keyframes.rows[keyframe]["state"].tolist()
        if keyframe == -1:
            (dx, dy, dz), turn = self._way.step(vio), self._way.turn
        else:
            (dx, dy, dz), turn = (vio - self._keyframes.rows[keyframe]["vio"]).tolist(), 0.0
        c, s = cos(yaw), sin(yaw)
        return np.array([x + c * dx + s * dz, y + dy, z + c * dz - s * dx, yaw + turn])

    # ------------------------------------------------------------ the fit

    def _fit(self) -> dict[str, float]:
        """Fit all keyframes anew, and change to another alignment where one has won; returns signals."""
        keyframes = self._keyframes
        newest = None if self._known is None else innovation(keyframes.rows, self._belief, self._known)
        # While there are few, each new one changes much.
        for _ in range(self.options.iterations if 2 * len(keyframes) <= self.options.keyframes else 1):
            fit = self._iterated(newest)
            newest = None
        usual = middle(fit.squared)
        self._doubted = self._surprised = bool(fit.squared[-_SURPRISES:].min() > _SURPRISING * usual)
        gain = -np.inf
        if self.options.rivals and len(keyframes) > 1 and fit.squared[-1] > _WORTH_A_LOOK * usual:
            rival = self._rival(fit)
            if rival is not None:
                gain = rival.gain
                if rival.gain > 0:
                    self._follow(rival)
                    fit = self._iterated()
                self._doubted |= rival.evidence > -_DOUBT
        self._known = fit.solution.covariance[-1]
        self._bound = alignment_covariance(keyframes.rows, fit, len(keyframes) - 1)
        self._judge_answers()
        signals = {"surprise": float(fit.squared[-1]), "weight": float(fit.weights[-1, POSITION])}
        if np.isfinite(gain):
            signals["rival_gain"] = gain
        return signals

    def _judge_answers(self) -> None:
        """Hold earlier answers against what is known of their poses by now, and remember the newest one."""
        newest = self._keyframes.rows[-1]
        for answered in self._hindsight.old(float(newest["time_s"])):
            self._hindsight.judge(answered, self._between(answered.vio, self._before(answered.time_s))[0])
        assert self._bound is not None
        now = Answered(float(newest["time_s"]), newest["vio"].copy(), newest["state"].copy(), self._bound)
        self._hindsight.remember(now)

    def settle(self) -> None:
        """Iterate the fit until it hardly changes, as `smoother` does at a walk's end."""
        if len(self._keyframes):
            for _ in range(_SETTLING):
                self._iterated()

    def revised(self, t_ns: int, vio_T_cam: Array) -> Estimate | None:
        """What is known by now of an earlier frame's pose (4, 4) in odometry's frame; None before any prediction."""
        keyframes = self._keyframes
        if not len(keyframes):
            return None
        if self._last is None:
            self._iterated()
        assert self._last is not None
        state, nearest = self._between(vio_T_cam[:3, 3], self._before(t_ns * 1e-9))
        bound = alignment_covariance(keyframes.rows, self._last, nearest)
        return self._posed(vio_T_cam, _Extrapolation(state, nearest, bound, _NOTHING), Status.FUSED, (), {})

    def _before(self, time_s: float) -> int:
        """The last keyframe at a time or before it, or else the first."""
        return max(int(np.searchsorted(self._keyframes.column("time_s"), time_s + 1e-6, side="right")) - 1, 0)

    def _between(self, vio: Array, at: int) -> tuple[Array, int]:
        """Position and yaw (4,) of a camera, at odometry's position (3,), between a keyframe and the next, and the
        nearer one of both: what odometry has drifted from the one to the other is shared out along the way."""
        rows, state = self._keyframes.rows, self._carried(vio, at)
        after = at + 1
        if after == len(rows) or rows[after]["segment"] != rows[at]["segment"]:
            return state, at
        gone, left = (float(np.linalg.norm(vio - rows[i]["vio"])) for i in (at, after))
        if gone == 0.0:
            return state, at
        fraction = gone / (gone + left)
        drifted = self._carried(vio, after) - state
        return state + fraction * drifted, at if fraction < 0.5 else after

    @property
    def _model(self) -> Model:
        o = self.options
        tilt_sd, prior = radians(o.tilt_sd_deg), self._prior
        if self._shrinkage is not None:
            prior = prior.for_covariances(self._shrinkage, o.size_count_stated, o.axis_count_stated)
        elif self._error_map is not None:
            prior = prior._replace(size_count=o.size_count_known)
        if self._quality.has_judged:
            prior = prior.with_sizes(self._quality.sizes, o.size_count_seen)
        sharing = Sharing(o.shared, o.shared_sizes, radians(o.shared_turn_deg))
        # A precise prediction's covariance is off by one factor for rotation and position, so both are gross together.
        extent = 1.0 if self._shrinkage is None else self._shrinkage
        marginal = extent * o.rotation_marginal, extent * o.position_marginal
        dof = o.degrees_of_freedom, max(o.degrees_of_freedom, o.position_degrees_of_freedom)
        return Model(prior, *dof, marginal, sharing, o.apart_m, tilt_sd)

    @property
    def _belief(self) -> Belief:
        return Belief(self._covariance, self._tilt, self._distrust)

    def _iterated(self, newest: tuple[float, float, float] | None = None) -> Fit:
        fit = iterate(self._keyframes.rows, self._model, self._belief, newest)
        self._covariance, self._last = fit.covariance, fit
        self._tilt, self._tilt_variance = fit.tilt, fit.tilt_variance
        return fit

    def _rival(self, fit: Fit) -> Rival | None:
        o = self.options
        count = o.evidence * counted(self._keyframes.column("along"), o.apart_m)
        dof = o.rival_degrees_of_freedom
        return best_rival(self._keyframes.rows, self._covariance, fit.squared, dof, o.recent, count)

    def _follow(self, rival: Rival) -> None:
        """Change to another alignment from some keyframe on."""
        self._quality.lost()
        keyframes = self._keyframes
        before = keyframes.column("state")[rival.begin].copy()
        lay(keyframes.rows, rival)
        if rival.kept == SAME_START:
            return
        if isnan(rival.segment):
            if self._cannot_be(rival.begin, before):
                self._unproven = self._count - 2 * (len(keyframes) - rival.begin)
            self._segment += 1
            keyframes.column("segment")[rival.begin :] = self._segment
            keyframes.column("loose")[rival.begin] = loose(rival.kept)
            keyframes.column("odds")[rival.begin] = CERTAIN
            return
        self._unproven = 0
        # An earlier alignment holds again: what lies between was another frame of odometry's, or wrong predictions.
        segment = keyframes.column("segment")
        segment[rival.begin :] = rival.segment
        same = np.flatnonzero(segment == rival.segment)
        before = int(same[same < rival.begin][-1])
        step = keyframes.column("vio")[rival.begin] - keyframes.column("vio")[before]
        keyframes.keep(np.concatenate([np.arange(before + 1), np.arange(rival.begin, len(keyframes))]))
        for name, value in (("step", step), ("turn", 0.0), ("loose", 0.0), ("odds", CERTAIN)):
            keyframes.column(name)[before + 1] = value
        self._segment = int(keyframes.column("segment")[-1])

    def _cannot_be(self, index: int, before: Array) -> bool:
        """Whether a keyframe, moved from a state (4,), is farther away than odometry can jump without a sign: then its
        place rather looks like another, or the walk began in such a one."""
        o, keyframes = self.options, self._keyframes
        if keyframes.column("rare")[index] < SIGN:
            return False
        moved = float(np.linalg.norm((keyframes.column("state")[index] - before)[:3]))
        seconds = float(keyframes.column("time_s")[index] - keyframes.column("time_s")[index - 1])
        sd = sqrt(float(position_variances(keyframes.rows, self._covariance)[index]))
        return moved > o.vio_jump_m + o.vio_speed_m_s * seconds + 2 * sd

    # ------------------------------------------------------------ answers

    def _estimate(
        self,
        vio_T_cam: Array,
        reasons: tuple[str, ...],
        signals: dict[str, float],
        map_T_cam_apr: Array | None = None,
    ) -> Estimate:
        """The newest frame's pose; `map_T_cam_apr` is its prediction, where that brought a covariance."""
        assert self._bound is not None
        status = Status.LOST if self._doubted or self._watched or self._unproven > 0 else Status.FUSED
        added = self._distrust * self._drift + self._way.added
        by_odometry = _Extrapolation(self._carried(vio_T_cam[:3, 3]), -1, self._bound, added)
        return self._posed(vio_T_cam, by_odometry, status, reasons, signals, map_T_cam_apr)

    def _posed(
        self,
        vio_T_cam: Array,
        by_odometry: _Extrapolation,
        status: Status,
        reasons: tuple[str, ...],
        signals: dict[str, float],
        map_T_cam_apr: Array | None = None,
    ) -> Estimate:
        """The pose that odometry gives from a keyframe, its tilt by the prediction where that knows it better."""
        state = by_odometry.state
        map_R_vio = rotation_into_map(state[3], self._tilt)
        tilt_variance = self.options.tilt_covariance_factor * self._tilt_variance + _TILT_JITTER
        if map_T_cam_apr is not None:
            apart = map_T_cam_apr[:3, :3] @ (map_R_vio @ vio_T_cam[:3, :3]).T
            tilt, tilt_variance = self._tilt_of(apart, tilt_variance)
            map_R_vio = leaning(tilt) @ map_R_vio
        keyframe = self._keyframes.rows[by_odometry.keyframe]["state"]
        bound = self._hindsight.widening * by_odometry.bound
        map_T_cam, map_T_vio, covariance = answer(state, map_R_vio, vio_T_cam, keyframe, bound, by_odometry.added)
        covariance[0, 0] = covariance[2, 2] = tilt_variance
        signals["position_sd_m"] = sqrt(sum(covariance.diagonal()[3:].tolist()))
        return Estimate(map_T_cam, status, covariance, map_T_vio, (), reasons, signals)

    def _tilt_of(self, rotation: Array, of_odometry: float) -> tuple[Array, float]:
        """What the newest prediction, turned from odometry's pose by a rotation (3, 3), says of the tilt about the
        map's x and z, (2,), and what variance that leaves of odometry's."""
        assert self._apr_covariance is not None and self._last is not None
        weight = min(float(self._last.weights[-1, ROTATION]), 1.0)
        of_prediction = self._common_factor / weight * self._apr_covariance[:3:2, :3:2]
        gain = of_odometry * np.linalg.inv(of_odometry * np.eye(2) + of_prediction)
        _, (x, z) = yaw_and_lean(rotation)
        return gain @ np.array([x, z]), float((gain @ of_prediction).trace()) / 2

    @property
    def _common_factor(self) -> float:
        """What predictions' own covariances are to be multiplied by."""
        return float(self._covariance.trace()) / DIMENSIONS

    def _without_odometry(self, map_T_cam_apr: Array | None) -> Estimate:
        """The prediction by itself."""
        if map_T_cam_apr is None:
            return Estimate(None, Status.NONE, reasons=("no_odometry", "no_prediction"))
        size = self._usual_sizes
        pose = map_T_cam_apr
        if self._error_map is not None:
            expected = self._error_map.expected(pose[:3, 3], pose[:3, 2])
            size = sizes_expected(expected)
            pose = make_pose(yaw_rotation(-expected.error[0]) @ pose[:3, :3], pose[:3, 3] - expected.error[1:])
        if self._apr_covariance is not None and self.options.covariances:
            covariance = self._common_factor * self._apr_covariance
        else:
            sd = size * np.sqrt(self._covariance.diagonal())
            turn = np.kron(np.eye(2), pose[:3, :3])
            covariance = turn @ np.diag(sd**2) @ turn.T
        return Estimate(pose, Status.PREDICTED, covariance, reasons=("no_odometry",))

    # ------------------------------------------------------------ the state as plain data

    def _state(self) -> State:
        return {
            "keyframes": self._keyframes.save(),
            "covariance": plain(self._covariance),
            "tilt": [plain(self._tilt), self._tilt_variance],
            "known": plain(self._known),
            "bound": plain(self._bound),
            "vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])],
            "way": self._way.save(),
            "along_m": self._along_m,
            "drift": plain(self._drift),
            "swung": self._swung,
            "distrust": plain(self._distrust),
            "quality": self._quality.save(),
            "hindsight": self._hindsight.save(),
            "predicted_at_m": self._predicted_at_m,
            "segment": self._segment,
            "count": self._count,
            "watched": self._watched,
            "doubted": self._doubted,
            "surprised": self._surprised,
            "unproven": self._unproven,
            "shrinkage": self._shrinkage,
        }

    def _set_state(self, state: State) -> None:
        self._forget()
        self._keyframes.restore(state["keyframes"])
        self._covariance, self._drift = np.array(state["covariance"]), np.array(state["drift"])
        self._swung = list(state["swung"])
        self._tilt, self._tilt_variance = np.array(state["tilt"][0]), state["tilt"][1]
        self._known, self._bound = array(state["known"]), array(state["bound"])
        self._distrust, self._predicted_at_m = np.array(state["distrust"]), state["predicted_at_m"]
        self._quality.restore(state["quality"])
        self._hindsight.restore(state["hindsight"])
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))
        self._way.restore(state["way"])
        self._along_m, self._segment, self._count = state["along_m"], state["segment"], state["count"]
        self._watched, self._doubted = state["watched"], state["doubted"]
        self._surprised, self._unproven = state["surprised"], state["unproven"]
        self._shrinkage = state["shrinkage"]
