"""How well odometry holds, learnt from predictions alone: small filters side by side, each of which supposes another
size of odometry's drift and of the predictions' errors, weighed by how well they predict.

Predictions that are wrong alike at a place look like drift for a while, and bad odometry looks like bad predictions.
What tells them apart is the long run: drift goes on growing, an error that neighbours share levels off. So only every
few metres a prediction is taken, and a hypothesis also says which share of its error the last one had in common with
it. Under each hypothesis odometry's offset and the shared error are two numbers an axis, which a Kalman filter with
the tails of Student's t follows. Nothing here hangs on the fit of the alignment but its yaw, so a fit that has gone
wrong doesn't confirm itself."""

from math import cos, exp, log, sin, sqrt
from typing import Any

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.robust import cost, weight
from groundwalk.fusion.methods.localiser import plain
from groundwalk.geometry.poses import Array

_DRIFT = 4.0 ** np.arange(6)  # factors of the usual variance of drift
_SIZE = 8.0 ** np.arange(-4, 4)  # of the expected variance of a prediction's error
_SHARED = ((0.0, 1.0), (0.6, 4.0), (0.9, 16.0))  # share of it that neighbours have in common, and metres it reaches
_HYPOTHESES = np.array([(d, s, *f) for d in _DRIFT for s in _SIZE for f in _SHARED])
_DRIFTS, _SIZES, _SHARES, _ = _HYPOTHESES.T
_LOG_FACTORS = np.log(_HYPOTHESES[:, :2])
_RARE = 0.4  # prior odds of each further factor of drift
_LOG_PRIOR = np.log(_RARE) * np.log(_DRIFTS) / np.log(4.0)
_NEAR = sqrt(2) * log(4.0)  # of the logarithm of height's factor about position's, one sigma
_SIZE_PRIOR = -((np.log(_SIZES) / np.log(2.0)) ** 2) / 2  # a factor of two, one sigma
_DOF = 1.5  # of Student's t
_KEPT = 0.98  # of the evidence so far, with each prediction taken
_EVERY_M = 2.5  # motion between two predictions taken, turns counted in
_MIN_VARIANCE = 1e-10
_MAX_YAW = 0.01  # variance, rad^2, of the yaw that carries the way on: an unknown one would excuse any drift
_COHERENT = 2.0  # that yaw is wrong alike from step to step


class _Bank:
    """The filters of one kind of error: `axes` numbers with the same variances."""

    def __init__(self, axes: int) -> None:
        hypotheses = len(_DRIFTS)
        self._offset = np.zeros((2, axes, hypotheses))  # odometry's, and the error shared with the last prediction
        self._P = np.zeros((3, hypotheses))  # variances of both, and their covariance
        self._log_odds = np.zeros(hypotheses)

    def begin(self, apart: Array, size: float) -> None:
        """The first prediction of a frame of odometry's: `apart` (axes,) from where odometry's way begins."""
        usual = size * _SIZES
        self._offset[0], self._offset[1] = apart[:, None], 0.0
        self._P[:] = usual, _SHARES * usual, -_SHARES * usual

    def update(self, apart: Array, drift: tuple[float, float], size: float, moved_m: float) -> None:
        """Take in the next one. drift: the usual variance on the way, and what is to be added to it anyhow."""
        variances = np.array([*drift, size])
        _filter(_HYPOTHESES, self._offset, self._P, self._log_odds, apart, variances, moved_m)

    def factors(self, sizes_known: bool, near: float | None = None) -> tuple[float, float]:
        """Of the usual variances of drift and of a prediction's error: means of their logarithms over hypotheses.
        near: what drift's factor is expected to be, where that isn't 1."""
        log_prior = _LOG_PRIOR if near is None else -((np.log(_DRIFTS / near) / _NEAR) ** 2) / 2
        return _mean_factors(_LOG_FACTORS, self._log_odds, log_prior + _SIZE_PRIOR if sizes_known else log_prior)

    def save(self) -> list[Any]:
        return [plain(self._offset), plain(self._P), plain(self._log_odds)]

    def restore(self, state: list[Any]) -> None:
        self._offset, self._P, self._log_odds = (np.array(part) for part in state)


@compiled
def _filter(
    hypotheses: Array, offset: Array, P: Array, log_odds: Array, apart: Array, variances: Array, moved_m: float
) -> None:
    """One step of all filters of a bank, which writes to its offsets, variances and evidence. variances (3,): the usual
    one of drift, what is to be added to it anyhow, and the one expected of the prediction's error."""
    axes = len(apart)
    error = np.empty(axes)
    for i in range(len(hypotheses)):
        drift, size, share, length = hypotheses[i]
        usual, faded = variances[2] * size, exp(-moved_m / length)
        P_a = P[0, i] + drift * variances[0] + variances[1]
        P_b = faded * faded * (P[1, i] - share * usual) + share * usual
        P_ab = faded * P[2, i]
        H_a, H_b, noise = P_a + P_ab, P_b + P_ab, (1 - share) * usual
        S, squared = H_a + H_b + noise, 0.0
        for axis in range(axes):
            offset[1, axis, i] *= faded
            error[axis] = apart[axis] - offset[0, axis, i] - offset[1, axis, i]
            squared += error[axis] * error[axis]
        squared /= S
        log_odds[i] = _KEPT * log_odds[i] - axes / 2 * log(S) - cost(squared, axes, _DOF)
        S = H_a + H_b + noise * max(1.0, 1 / weight(squared, axes, _DOF)) + _MIN_VARIANCE
        G_a, G_b = H_a / S, H_b / S
        for axis in range(axes):
            offset[0, axis, i] += G_a * error[axis]
            offset[1, axis, i] += G_b * error[axis]
        P[0, i], P[1, i], P[2, i] = P_a - G_a * H_a, P_b - G_b * H_b, P_ab - G_a * H_b
    most = max(log_odds)
    for i in range(len(log_odds)):
        log_odds[i] -= most


@compiled
def _mean_factors(log_factors: Array, log_odds: Array, log_prior: Array) -> tuple[float, float]:
    """Factors of drift and size: means of their logarithms over hypotheses (N, 2)."""
    total = drift = size = 0.0
    for i in range(len(log_odds)):
        odds = exp(log_odds[i] + log_prior[i])
        total += odds
        drift += odds * log_factors[i, 0]
        size += odds * log_factors[i, 1]
    return exp(drift / total), exp(size / total)


@compiled
def expected_variances(whitening: Array) -> tuple[float, float]:
    """Of a prediction's position an axis and of its yaw, from what normalises its error (6, 6)."""
    position = yaw = 0.0
    for k in range(6):
        yaw += whitening[1, k] ** 2
        for j in range(3, 6):
            position += whitening[j, k] ** 2
    return 3 / position, 1 / yaw


class OdometryQuality:
    """Fed with each prediction; `factors` (4,) are of the usual variances of drift in x, y, z and yaw, `sizes` (6,) of
    the expected sizes of predictions' errors."""

    def __init__(self) -> None:
        self._position, self._height, self._yaw = _Bank(2), _Bank(1), _Bank(1)
        self.factors, self.sizes = np.ones(4), np.ones(6)
        self.is_known = False
        # The next prediction may be of another place, or odometry have lost its frame: neither tells how far it drifts.
        self.paused = False
        self.sizes_known = False  # held-out frames or covariances say how large errors are
        self._forget_way()

    def _forget_way(self) -> None:
        self._begun = False  # a prediction has been taken in this frame of odometry's
        self._at = np.zeros(3)  # where odometry's way has come to in the map, begun anywhere
        # Since the last prediction taken: metres, usual drift of position, height and yaw, and of bent ways.
        self._since = np.zeros(5)

    def lost(self) -> None:
        """Odometry has lost its frame, or may have: its offset is unknown again, its quality isn't."""
        self._forget_way()

    def update(
        self,
        measured: Array,
        size: tuple[float, float],
        way: Array,
        moved_m: float,
        drift: Array,
        yaw: float,
        yaw_variance: float,
    ) -> None:
        """Take in a prediction.

        measured: its position and its yaw against odometry, (4,). size: variances expected of its position's and
        yaw's errors. way (3,), moved_m, drift (4,): odometry's step since the last one, its length with turns counted
        in, and usual variances. yaw, yaw_variance: the alignment's, as known before.
        """
        x, y, z = way.tolist()
        c, s = cos(yaw), sin(yaw)
        self._at += c * x + s * z, y, c * z - s * x
        bent = _COHERENT * min(yaw_variance, _MAX_YAW) * (x * x + z * z)
        self._since += moved_m, drift[0], drift[1], drift[3], bent
        apart, turned = measured[:3] - self._at, measured[3:4]
        if not self._begun:
            self._begun = True
            self._position.begin(apart[::2], size[0])
            self._height.begin(apart[1:2], size[0])
            self._yaw.begin(turned, size[1])
            self._since[:] = 0.0
            return
        metres, position, height, heading, bent = self._since.tolist()
        if metres < _EVERY_M or self.paused:
            return
        self._position.update(apart[::2], (position, bent), size[0], metres)
        self._height.update(apart[1:2], (height, 0.0), size[0], metres)
        self._yaw.update(turned, (heading, 0.0), size[1], metres)
        self._since[:] = 0.0
        position, position_size = self._position.factors(self.sizes_known)
        height, _ = self._height.factors(self.sizes_known, position)
        heading, yaw_size = self._yaw.factors(self.sizes_known)
        self.factors = np.array([position, height, position, heading])
        self.sizes = np.sqrt(np.repeat([yaw_size, position_size], 3))
        self.is_known = True

    def save(self) -> list[Any]:
        """The state as plain data."""
        return [
            self._position.save(),
            self._height.save(),
            self._yaw.save(),
            self._begun,
            self.is_known,
            *map(plain, self._arrays()),
        ]

    def restore(self, state: list[Any]) -> None:
        """Take over what `save` gave."""
        self._position.restore(state[0])
        self._height.restore(state[1])
        self._yaw.restore(state[2])
        self._begun, self.is_known = state[3:5]
        self.factors, self.sizes, self._at, self._since = (np.array(part) for part in state[5:])

    def _arrays(self) -> tuple[Array, ...]:
        return self.factors, self.sizes, self._at, self._since
