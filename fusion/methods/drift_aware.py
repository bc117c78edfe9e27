"""Method `drift_aware`: the alignment as a slowly drifting state, fitted to all the evidence that is kept, again and
again.

Odometry and map are both gravity-aligned, so odometry drifts in yaw and position only. Predictions are kept as
keyframes (keyframes.py); with each new one the alignment's whole course is fitted to all of them anew
(fit.py), so that what a prediction counts is decided again with each that follows. Where the newest ones are
explained better by another alignment, odometry has lost its frame, or found it again (alternatives.py).

Method `smoother` answers after the whole walk, for labelling. It is the same fit: later predictions re-weigh earlier
ones, and the alignment at an earlier keyframe is read from it."""

from math import acos, atan2, cos, degrees, hypot, isnan, log, nan, pi, radians, sin, sqrt

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from groundwalk.fusion.methods.estimator.alternatives import (
    PLACE,
    SIGN,
    Alternative,
    adopt,
    best_alternative,
    lost_variances,
    starts_here,
)
from groundwalk.fusion.methods.estimator.calibration import Calibration
from groundwalk.fusion.methods.estimator.fit import DOF, Belief, Fit, alignment_covariance, innovation, iterate
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.fusion.methods.estimator.odometry_quality import OdometryQuality
from groundwalk.fusion.methods.estimator.odometry_step import CERTAIN, OdometryStep
from groundwalk.fusion.methods.estimator.prediction_errors import (
    Prior,
    expected_variances,
    shrinkage_of,
    shrunk,
    side_turn_correlation,
    whitening,
)
from groundwalk.fusion.methods.localiser import Estimate, Localiser, Status
from groundwalk.fusion.methods.odometry import OdometryOptions
from groundwalk.fusion.methods.offline import Offline, frames, stepped
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import Array, heading, make_pose, yaw_rotation
from groundwalk.scoring.errors import pose_error

# Standing still drifts a little too: what a second adds to the variances, of what a metre does.
_STANDING = 0.05
_STANDING_YAW = 0.02
_HEIGHT_DRIFT = 0.27  # of the horizontal drift: gravity holds the height (docs/explanation/vio-drift.md)
_GAP_S = 10.0  # without a frame: odometry may have begun anew
_FASTEST_TURN_DEG_S, _TURN_JUMP_DEG = 360.0, 15.0  # a phone turns no faster, give or take
# Over so many seconds at most the phone is taken to have gone on as it did while odometry jumped, to within so many
# metres and degrees a second, one sigma; where the camera's heading holds, it may have turned.
_JUMP_S, _JUMP_M_S, _JUMP_DEG, _JUMP_TURN_DEG_S = 2.0, 0.5, 3.0, 60.0
_LOSS, _LOSS_IN_A_JUMP = 1e-6, 0.05  # probability that odometry lost its frame: at any prediction, and in a jump
_TURN_LENGTH_M = 1.0  # motion that a turn by one radian counts as
_SIDE_TURN, _SIDE_TURN_COUNT = 0.7, 20.0  # correlation of errors to the side with yaw's, and predictions it counts as
# Predictions that errors' sizes count as which are assumed first, stated by covariances, and seen beside odometry.
_SIZE_COUNT, _SIZE_COUNT_STATED, _SIZE_COUNT_SEEN = 0.3, 10.0, 12.0
_AXIS_COUNT, _AXIS_COUNT_STATED = 10.0, 100.0  # predictions that errors' being as large along each axis counts as
# Of odometry's pose of one frame, one sigma an axis: ARKit beside the ground truth of three real captures.
_JITTER_DEG, _JITTER_M = 0.05, 0.002
_LEAST_DRIFT = np.array([1e-8, 1e-8, 1e-8, 1e-10])
_SETTLING = 20
_WORTH_A_LOOK = 2.0  # squared error, over the usual one, of a prediction that may be of another alignment
# So many predictions in a row that are this much farther off (in the square) than usual: something is wrong.
_INCONSISTENT, _FARTHER_OFF = 4, 8.0
_DOUBT = 3.0  # nats by which an alternative may be behind and the alignment still be doubted


class DriftAwareOptions(OdometryOptions):
    vio_speed_m_s: float = Field(1.5, gt=0, description="fastest motion that odometry is believed without question")
    vio_jump_m: float = Field(0.5, gt=0, description="motion beyond that speed that may be an odometry jump")
    drift_m: float = Field(0.03, gt=0, description="odometry's drift over one metre, one sigma, as a random walk")
    drift_deg_m: float = Field(0.35, gt=0, description="odometry's yaw drift over one metre, one sigma")
    tilt_sd_deg: float = Field(0.3, gt=0, description="odometry's gravity error an axis, one sigma")
    position_sd_m: float = Field(0.3, gt=0, description="a prediction's first assumed position error an axis")
    rotation_sd_deg: float = Field(8.0, gt=0, description="a prediction's first assumed rotation error an axis")
    keyframes: int = Field(64, ge=8, description="predictions kept as evidence")


class DriftAware(Localiser):
    """Every frame from the first prediction on gets a pose and a covariance."""

    options_type = DriftAwareOptions
    options: DriftAwareOptions
    _not_saved = (*Localiser._not_saved, "_prior", "_last")

    def __init__(self, options: DriftAwareOptions | None = None, forgetful: bool = True) -> None:
        """`forgetful`: memory is bounded; else all predictions are kept, for `revised`."""
        self._forgetful = forgetful
        super().__init__(options)

    def _forget(self) -> None:
        o = self.options
        self._prior = Prior(side_turn_correlation(_SIDE_TURN), _SIDE_TURN_COUNT, _SIZE_COUNT, _AXIS_COUNT)
        self._usual_sizes = np.repeat([radians(o.rotation_sd_deg), o.position_sd_m], 3)
        yaw_m, position, height = radians(o.drift_deg_m) ** 2, o.drift_m**2, (_HEIGHT_DRIFT * o.drift_m) ** 2
        self._drift_a_metre = np.array([position, height, position, yaw_m])
        self._drift_a_second = _STANDING * self._drift_a_metre
        self._drift_a_second[3] = _STANDING_YAW * yaw_m
        self._jitter = np.diag(np.repeat([radians(_JITTER_DEG), _JITTER_M], 3) ** 2)
        self._keyframes = Keyframes(o.keyframes if self._forgetful else None)
        self._covariance = self._prior.shape.copy()  # of normalised errors
        self._last: Fit | None = None
        self._known: Array | None = None  # the fit's own covariance of the newest keyframe's state
        self._bound: Array | None = None  # covariance (4, 4) of the newest keyframe's x, y, z and yaw, in map axes
        self._vio: tuple[int, Array] | None = None
        self._odometry_step = OdometryStep()
        # Of odometry's vertical against the map's, about its x and z (rad), and the variance an axis.
        self._lean, self._lean_variance = np.zeros(2), radians(o.tilt_sd_deg) ** 2
        self._quality = OdometryQuality(self._lean_variance)
        self._calibration = Calibration()
        self._along_m = 0.0  # motion since the start, turns counted in
        self._drift = np.zeros(4)  # variances since the newest keyframe
        self._yaw_covariance = [0.0, 0.0]  # of x and z since then, by steps after the yaw has drifted
        self._segment = 0
        self._count = 0  # predictions taken in since odometry's tracking was last lost
        self._may_be_lost = False  # odometry has jumped, or was gone, since the newest keyframe
        self._shrinkage: float | None = None  # of the newest prediction's covariance, if it brought one
        self._inconsistent = False  # something is wrong with the newest predictions, or with the alignment
        self._ambiguous = False  # that, or another alignment explains the newest predictions nearly as well
        self._unconfirmed = 0  # predictions that the alignment in force must explain yet until it is believed

    # ------------------------------------------------------------ a frame

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        if vio_T_cam is None:
            self._may_be_lost |= self._vio is not None
            return self._without_odometry(map_T_cam_predicted)
        reasons: tuple[str, ...] = ()
        if self._vio is None:
            self._odometry_step.begin(vio_T_cam[:3, 3])
        elif self._move(t_ns, vio_T_cam):
            self._may_be_lost = True
            reasons = ("odometry_jump",)
        self._vio = (t_ns, vio_T_cam)
        if map_T_cam_predicted is None:
            if not len(self._keyframes):
                return Estimate(None, Status.NONE, reasons=("no_prediction",))
            return self._estimate(vio_T_cam, (*reasons, "no_prediction"), {})
        if not len(self._keyframes):
            reasons = ("first_prediction",)
        self._add_keyframe(t_ns, vio_T_cam, map_T_cam_predicted)
        signals = self._fit()
        return self._estimate(vio_T_cam, reasons, signals, map_T_cam_predicted)

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
        gone = seconds > _GAP_S
        turned = degrees(angle) > _FASTEST_TURN_DEG_S * seconds + _TURN_JUMP_DEG
        too_long = length > o.vio_speed_m_s * seconds + o.vio_jump_m
        jumped = turned or (too_long and self._odometry_step.is_unlike([dx, dy, dz], seconds, _JUMP_M_S))
        if jumped and seconds <= _JUMP_S:
            sd_deg = _JUMP_DEG + (_JUMP_TURN_DEG_S * seconds if turned else 0.0)
            sds = _JUMP_M_S * seconds, radians(sd_deg)
            moved = self._odometry_step.bridge(self._vio[1], vio_T_cam, seconds, turned, sds)
            self._segment += 1
            length, angle = hypot(*moved), 0.0 if turned else angle
        elif not jumped:
            self._odometry_step.go([dx, dy, dz], seconds)
            # A step is off to the side by how much the yaw has drifted by now.
            yaw, (x, z) = float(self._drift[3]), self._yaw_covariance
            more = dz * x - dx * z + (dx * dx + dz * dz) * yaw / 2
            self._drift = self._drift + np.array([more, 0.0, more, 0.0])
            self._yaw_covariance = [x + dz * yaw, z - dx * yaw]
        self._along_m += length + _TURN_LENGTH_M * angle
        self._drift = self._drift + length * self._drift_a_metre + seconds * self._drift_a_second
        return jumped or gone

    def _add_keyframe(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array) -> None:
        """Keep a prediction as the newest keyframe."""
        map_R_vio, position = map_T_cam_predicted[:3, :3] @ vio_T_cam[:3, :3].T, map_T_cam_predicted[:3, 3]
        yaw = float(heading(map_R_vio))
        # What is left has no yaw: it turns the vertical about an axis of the horizontal plane.
        x, up, z = map_R_vio[:, 1].tolist()
        sine = hypot(x, z)
        tilt = atan2(sine, up) / sine if sine > 0 else 1.0
        stated = self._predicted_covariance
        if stated is None:
            self._shrinkage = None
            expected = np.diag(self._usual_sizes**2)
        else:
            self._shrinkage = shrinkage_of(stated, (self._quality.factors * self._drift + _LEAST_DRIFT)[:3])
            turn = np.kron(np.eye(2), map_T_cam_predicted[:3, :3])
            expected = turn.T @ (shrunk(stated, self._shrinkage) + self._jitter) @ turn
        normalised = whitening(expected, vio_T_cam[:3, :3])
        state = self._carried(vio_T_cam[:3, 3]) if len(self._keyframes) else np.array([*position, yaw])
        self._learn_quality(np.array([*position, yaw, tilt * z, -tilt * x]), normalised, state, vio_T_cam)
        bridged = self._odometry_step.added_variance.any()
        loss = _LOSS_IN_A_JUMP if bridged else 0.5 if self._may_be_lost else _LOSS
        if self._may_be_lost and not bridged:
            self._count = 0
        self._keyframes.add(
            whitening=normalised,
            measured=(*position, yaw, tilt * z, -tilt * x),
            vio=vio_T_cam[:3, 3],
            forward=vio_T_cam[:3, 2],
            step=self._odometry_step.step(vio_T_cam[:3, 3]),
            turn=self._odometry_step.turn,
            drift=self._drift + _LEAST_DRIFT,
            added_variance=self._odometry_step.added,
            bridged=self._odometry_step.bridged(vio_T_cam[:3, 3]),
            moved=self._odometry_step.moved(vio_T_cam[:3, 3]),
            bridge=self._odometry_step.added_variance,
            odds=self._odometry_step.odds,
            state=state,
            posterior=self._keyframes.rows[-1]["posterior"] if len(self._keyframes) else 0.0,
            along=self._along_m,
            time_s=t_ns * 1e-9,
            segment=self._segment,
            kept_odds=log((1 - loss) / loss),
        )
        self._odometry_step.begin(vio_T_cam[:3, 3])
        self._drift, self._yaw_covariance, self._may_be_lost = np.zeros(4), [0.0, 0.0], False
        self._count += 1
        self._unconfirmed -= 1

    def _learn_quality(self, measured: Array, normalised: Array, state: Array, vio_T_cam: Array) -> None:
        if self._may_be_lost:
            self._quality.lost()
        self._quality.paused = self._inconsistent
        # A yaw is measured as it was before, give or take half a turn.
        measured[3] = state[3] + (measured[3] - state[3] + pi) % (2 * pi) - pi
        self._quality.update(
            measured,
            expected_variances(normalised),
            np.zeros(3) if self._may_be_lost else np.array(self._odometry_step.step(vio_T_cam[:3, 3])),
            self._along_m - (self._keyframes.rows[-1]["along"] if len(self._keyframes) else 0.0),
            self._drift,
            (state[3], 1.0 if self._known is None else float(self._known[3, 3])),
            self._shrinkage is not None,
        )

    def _carried(self, vio: Array, keyframe: int = -1) -> Array:
        """Position and yaw (4,) of a camera: a keyframe's, by default the newest's, moved on to odometry's position
        (3,)."""
        x, y, z, yaw = self._keyframes.rows[keyframe]["state"].tolist()
        if keyframe == -1:
            (dx, dy, dz), turn = self._odometry_step.step(vio), self._odometry_step.turn
        else:
            (dx, dy, dz), turn = (vio - self._keyframes.rows[keyframe]["vio"]).tolist(), 0.0
        c, s = cos(yaw), sin(yaw)
        return np.array([x + c * dx + s * dz, y + dy, z + c * dz - s * dx, yaw + turn])

    # ------------------------------------------------------------ the fit

    def _fit(self) -> dict[str, float]:
        """Fit all keyframes anew, and change to another alignment where one has won; returns signals."""
        keyframes = self._keyframes
        newest = nan if self._known is None else innovation(keyframes.rows, self._belief, self._known)
        fit = self._iterated(newest)
        if 2 * len(keyframes) <= self.options.keyframes:  # while there are few, each new one changes much
            fit = self._iterated()
        usual = np.median(fit.squared)
        self._ambiguous = self._inconsistent = bool(fit.squared[-_INCONSISTENT:].min() > _FARTHER_OFF * usual)
        gain = -np.inf
        if len(keyframes) > 1 and fit.squared[-1] > _WORTH_A_LOOK * usual:
            alternative = best_alternative(keyframes.rows, self._covariance, fit.squared)
            if alternative is not None:
                gain = alternative.gain
                if alternative.gain > 0:
                    self._adopt(alternative)
                    fit = self._iterated()
                self._ambiguous |= alternative.gain > -_DOUBT
        self._known = fit.solution.covariance[-1]
        self._bound = alignment_covariance(keyframes.rows, fit, len(keyframes) - 1)
        self._calibrate()
        signals = {"squared_error": float(fit.squared[-1]), "weight": float(fit.weights[-1])}
        if np.isfinite(gain):
            signals["alternative_gain"] = gain
        return signals

    def _calibrate(self) -> None:
        """Hold earlier answers against what is known of their poses by now, and remember the newest one."""
        newest = self._keyframes.rows[-1]
        for time_s, vio, state, bound in self._calibration.due(float(newest["time_s"])):
            self._calibration.compare(state, bound, self._between(vio, self._before(time_s))[0])
        assert self._bound is not None
        self._calibration.remember((float(newest["time_s"]), newest["vio"].copy(), newest["state"].copy(), self._bound))

    def settle(self) -> None:
        """Iterate the fit until it hardly changes, as `smoother` does at a walk's end."""
        if len(self._keyframes):
            for _ in range(_SETTLING):
                self._iterated()

    def revised(
        self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None, predicted_covariance: Array | None
    ) -> Estimate | None:
        """What is known by now of an earlier frame's pose (4, 4) in odometry's frame; None before any prediction."""
        keyframes = self._keyframes
        if not len(keyframes):
            return None
        assert self._last is not None
        at = self._before(t_ns * 1e-9)
        state, nearest = self._between(vio_T_cam[:3, 3], at)
        bound = alignment_covariance(keyframes.rows, self._last, nearest)
        pose, alignment, covariance = self._posed(vio_T_cam, state, nearest, bound, np.zeros(4))
        if map_T_cam_predicted is not None and keyframes.rows["time_s"][at] == t_ns * 1e-9:
            of_prediction = self._covariance_of(map_T_cam_predicted, predicted_covariance)
            pose, covariance = self._corrected(pose, covariance, map_T_cam_predicted, of_prediction, at)
        return Estimate(pose, Status.FUSED, covariance, alignment)

    def _before(self, time_s: float) -> int:
        """The last keyframe at a time or before it, or else the first."""
        return max(int(np.searchsorted(self._keyframes.rows["time_s"], time_s + 1e-6, side="right")) - 1, 0)

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
    def _belief(self) -> Belief:
        # Sizes that were assumed first are forgotten as predictions come, so that small errors soon show.
        prior = self._prior._replace(size_count=_SIZE_COUNT / (1 + len(self._keyframes)))
        lean_variance = radians(self.options.tilt_sd_deg) ** 2
        if self._shrinkage is not None:
            # Errors whitened by stated covariances have one common factor, as far as those are believed.
            believed = 1 - self._shrinkage
            shape = believed * np.eye(6) + (1 - believed) * prior.shape
            axis_count = believed * _AXIS_COUNT_STATED + (1 - believed) * _AXIS_COUNT
            prior = prior._replace(shape=shape, size_count=_SIZE_COUNT_STATED, axis_count=axis_count)
        if self._quality.is_known:
            count = prior.size_count + _SIZE_COUNT_SEEN
            prior = prior._replace(sizes=self._quality.sizes, size_count=count)
        return Belief(prior, self._covariance, self._quality.factors, self._lean, lean_variance)

    def _iterated(self, newest: float = nan) -> Fit:
        fit = self._last = iterate(self._keyframes.rows, self._belief, newest)
        self._covariance, self._lean, self._lean_variance = fit.covariance, fit.lean, fit.lean_variance
        return fit

    def _adopt(self, alternative: Alternative) -> None:
        """Change to another alignment from some keyframe on."""
        self._quality.lost()
        keyframes = self._keyframes
        starts = starts_here(keyframes.rows, alternative.begin, alternative.kept)
        adopt(keyframes.rows, alternative)
        if isnan(alternative.segment):
            if not starts:
                # Without a sign a place rather looks like another one, or the walk began in such a place.
                if alternative.kept != PLACE and keyframes.rows["kept_odds"][alternative.begin] >= SIGN:
                    self._unconfirmed = self._count - 2 * (len(keyframes) - alternative.begin)
                self._segment += 1
                keyframes.rows["segment"][alternative.begin :] = self._segment
                keyframes.rows["added_variance"][alternative.begin] = lost_variances(alternative.kept)
                keyframes.rows["odds"][alternative.begin] = CERTAIN
            return
        self._unconfirmed = 0
        # An earlier alignment holds again: what lies between was another frame of odometry's, or wrong predictions.
        segment = keyframes.rows["segment"]
        segment[alternative.begin :] = alternative.segment
        same = np.flatnonzero(segment == alternative.segment)
        before = int(same[same < alternative.begin][-1])
        step = keyframes.rows["vio"][alternative.begin] - keyframes.rows["vio"][before]
        for index in range(alternative.begin - 1, before, -1):
            keyframes.remove(index)
        for name, value in (("step", step), ("turn", 0.0), ("added_variance", 0.0), ("odds", CERTAIN)):
            keyframes.rows[name][before + 1] = value
        self._segment = int(keyframes.rows["segment"][-1])

    # ------------------------------------------------------------ answers

    def _estimate(
        self,
        vio_T_cam: Array,
        reasons: tuple[str, ...],
        signals: dict[str, float],
        map_T_cam_predicted: Array | None = None,
    ) -> Estimate:
        """The newest frame's pose, with its prediction, if there is one."""
        assert self._bound is not None
        status = Status.LOST if self._ambiguous or self._may_be_lost or self._unconfirmed > 0 else Status.FUSED
        added = self._quality.factors * self._drift + self._odometry_step.added
        pose, alignment, covariance = self._posed(vio_T_cam, self._carried(vio_T_cam[:3, 3]), -1, self._bound, added)
        if map_T_cam_predicted is not None:
            of_prediction = self._covariance_of(map_T_cam_predicted, self._predicted_covariance)
            pose, covariance = self._corrected(pose, covariance, map_T_cam_predicted, of_prediction, -1)
        signals["position_sd_m"] = sqrt(sum(covariance.diagonal()[3:].tolist()))
        return Estimate(pose, status, covariance, alignment, (), reasons, signals)

    def _posed(
        self, vio_T_cam: Array, state: Array, keyframe: int, bound: Array, added: Array
    ) -> tuple[Array, Array, Array]:
        """map_T_cam and map_T_vio (4, 4), and the covariance (6, 6) of the pose's error, of a camera with this position
        and yaw (4,): carried from a keyframe, of which `bound` (4, 4) is the covariance, over a way that adds to the
        variances (4,)."""
        lean = Rotation.from_rotvec([self._lean[0], 0.0, self._lean[1]]).as_matrix()
        map_R_vio = yaw_rotation(state[3]) @ lean
        map_T_cam = make_pose(map_R_vio @ vio_T_cam[:3, :3], state[:3])
        map_T_vio = make_pose(map_R_vio, state[:3] - map_R_vio @ vio_T_cam[:3, 3])
        slope = np.eye(6, 4, -3)  # of the pose's rotation and position by the keyframe's x, y, z and yaw
        x, _, z, _ = state - self._keyframes.rows[keyframe]["state"]
        slope[[1, 3, 5], 3] = 1.0, z, -x  # its yaw turns the way since
        covariance = slope @ (self._calibration.inflation * bound) @ slope.T + self._jitter
        covariance[range(6), range(6)] += self._lean_variance, added[3], self._lean_variance, *added[:3]
        return map_T_cam, map_T_vio, covariance

    def _corrected(
        self, map_T_cam: Array, covariance: Array, map_T_cam_predicted: Array, of_prediction: Array, keyframe: int
    ) -> tuple[Array, Array]:
        """The pose of a keyframe and its covariance after its own prediction: of a frame's pose odometry knows no more
        than up to its jitter and its vertical, and a prediction may know it better."""
        assert self._last is not None
        of_prediction = of_prediction / min(float(self._last.weights[keyframe]), 1.0)
        jitter = self._jitter + self._lean_variance * np.diag([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        gain = jitter @ np.linalg.inv(jitter + of_prediction)
        step = gain @ pose_error(map_T_cam, map_T_cam_predicted)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ map_T_cam[:3, :3]
        # The state has followed the prediction already, so what it is off by doesn't average out. Student's t of so few
        # degrees of freedom has a larger covariance than its scale says.
        tails = (DOF / (DOF - 2) - 1) * gain @ of_prediction @ gain.T
        return make_pose(rotation, map_T_cam[:3, 3] + step[3:]), covariance - gain @ jitter + tails

    def _covariance_of(self, map_T_cam_predicted: Array, stated: Array | None) -> Array:
        """The covariance (6, 6) of a prediction in map axes: what it states, times a common factor, or what was learnt
        of errors."""
        if stated is None:
            turn = np.kron(np.eye(2), map_T_cam_predicted[:3, :3])
            return np.asarray(turn @ np.diag(self._usual_sizes**2 * self._covariance.diagonal()) @ turn.T)
        # Errors were learnt beside odometry's jitter, which can't show that a small covariance is too large.
        learnt = float(self._covariance[3:, 3:].trace()) / 3
        variance, jitter = (float(matrix[3:, 3:].trace()) for matrix in (stated, self._jitter))
        return max(1.0, (learnt * (variance + jitter) - jitter) / variance) * stated

    def _without_odometry(self, map_T_cam_predicted: Array | None) -> Estimate:
        """The prediction by itself."""
        if map_T_cam_predicted is None:
            return Estimate(None, Status.NONE, reasons=("no_odometry", "no_prediction"))
        covariance = self._covariance_of(map_T_cam_predicted, self._predicted_covariance)
        return Estimate(map_T_cam_predicted, Status.PREDICTED, covariance, reasons=("no_odometry",))


class Smoother(Offline):
    """Each frame's pose from what is known in the end. A frame without odometry has its raw prediction."""

    def __init__(self, options: DriftAwareOptions | None = None) -> None:
        self.options = options or DriftAwareOptions()

    def estimates(self, walk: Walk) -> list[Estimate]:
        localiser = DriftAware(self.options, forgetful=False)
        in_time = stepped(localiser, walk)
        localiser.settle()
        late: list[Estimate] = []
        for estimate, (t_ns, vio_T_cam, predicted, _, covariance) in zip(in_time, frames(walk), strict=True):
            revised = None if vio_T_cam is None else localiser.revised(t_ns, vio_T_cam, predicted, covariance)
            late.append(revised or estimate)
        return late
