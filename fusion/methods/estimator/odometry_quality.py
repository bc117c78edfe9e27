"""How well odometry holds, learnt from predictions alone: small filters side by side, each of which supposes another
size of odometry's drift and of the predictions' errors, weighed by how well they predict.

Predictions that are wrong alike at a place look like drift for a while, and bad odometry looks like bad predictions.
What tells them apart is the long run: drift goes on growing, an error that neighbours share levels off. So only every
few metres a prediction is taken, and a hypothesis also says which share of its error the last one had in common with
it. Under each hypothesis odometry's offset and the shared error are two numbers an axis, which a Kalman filter with
the tails of Student's t follows. Nothing here hangs on the fit of the alignment but its yaw, so a fit that has gone
wrong doesn't confirm itself."""

from math import cos, sin
from typing import Any

import numpy as np

from groundwalk.fusion.methods.localiser import plain
from groundwalk.geometry.poses import Array

_DRIFT = 4.0 ** np.arange(6)  # factors of the usual variance of drift
_SIZE = 8.0 ** np.arange(-4, 4)  # of the expected variance of a prediction's error
_SHARED = ((0.0, 1.0), (0.6, 4.0), (0.9, 16.0))  # share of it that neighbours have in common, and metres it reaches
_DRIFTS, _SIZES, _SHARES, _LENGTHS = np.array([(d, s, *f) for d in _DRIFT for s in _SIZE for f in _SHARED]).T
_RARE = 0.4  # prior odds of each further factor of drift
_LOG_PRIOR = np.log(_RARE) * np.log(_DRIFTS) / np.log(4.0)
_LOG_PRIOR_KNOWN = _LOG_PRIOR - (np.log(_SIZES) / np.log(2.0)) ** 2 / 2  # a factor of two, one sigma
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
        self.begun = False

    def begin(self, apart: Array, size: float) -> None:
        """The first prediction of a frame of odometry's: `apart` (axes,) from where odometry's way begins."""
        usual = size * _SIZES
        self._offset[0], self._offset[1] = apart[:, None], 0.0
        self._P[:] = usual, _SHARES * usual, -_SHARES * usual
        self.begun = True

    def update(self, apart: Array, drift: tuple[float, float], size: float, moved_m: float) -> None:
        """Take in the next one. drift: the usual variance on the way, and what is to be added to it anyhow."""
        axes = len(apart)
        usual = size * _SIZES
        a, b = self._offset
        faded = np.exp(-moved_m / _LENGTHS)
        P_a, P_b, P_ab = self._P
        P_a = P_a + _DRIFTS * drift[0] + drift[1]
        P_b = faded * faded * (P_b - _SHARES * usual) + _SHARES * usual
        P_ab = faded * P_ab
        b *= faded
        H_a, H_b, noise = P_a + P_ab, P_b + P_ab, (1 - _SHARES) * usual
        S = H_a + H_b + noise
        error = apart[:, None] - a - b
        squared = (error * error).sum(axis=0) / S
        log_density = -axes / 2 * np.log(S) - (_DOF + axes) / 2 * np.log1p(squared / _DOF)
        self._log_odds = _KEPT * self._log_odds + log_density
        self._log_odds -= self._log_odds.max()
        S = H_a + H_b + noise * np.maximum(1.0, (_DOF + squared) / (_DOF + axes)) + _MIN_VARIANCE
        G_a, G_b = H_a / S, H_b / S
        a += G_a * error
        b += G_b * error
        self._P[:] = P_a - G_a * H_a, P_b - G_b * H_b, P_ab - G_a * H_b

    def factors(self, sizes_known: bool) -> tuple[float, float]:
        """Of the usual variances of drift and of a prediction's error: means of their logarithms over hypotheses."""
        odds = np.exp(self._log_odds + (_LOG_PRIOR_KNOWN if sizes_known else _LOG_PRIOR))
        odds /= odds.sum()
        return float(np.exp(odds @ np.log(_DRIFTS))), float(np.exp(odds @ np.log(_SIZES)))

    def save(self) -> list[Any]:
        return [plain(self._offset), plain(self._P), plain(self._log_odds), self.begun]

    def restore(self, state: list[Any]) -> None:
        self._offset, self._P, self._log_odds = (np.array(part) for part in state[:3])
        self.begun = state[3]


class OdometryQuality:
    """Fed with each prediction; `factors` (4,) are of the usual variances of drift in x, y, z and yaw, `sizes` (6,) of
    the expected sizes of predictions' errors."""

    def __init__(self) -> None:
        self._position, self._yaw = _Bank(2), _Bank(1)
        self.factors, self.sizes = np.ones(4), np.ones(6)
        self.has_judged = False
        self.sizes_known = False  # held-out frames or covariances say how large errors are
        self._forget_way()

    def _forget_way(self) -> None:
        self._at = np.zeros(2)  # where odometry's way has come to, x and z in the map, begun anywhere
        self._since = np.zeros(
            4
        )  # the last prediction taken: metres, usual drift of position and yaw, and of bent ways

    def lost(self) -> None:
        """Odometry has lost its frame, or may have: its offset is unknown again, its quality isn't."""
        self._position.begun = self._yaw.begun = False
        self._forget_way()

    def update(
        self, measured: Array, size: Array, way: Array, moved_m: float, drift: Array, yaw: float, yaw_variance: float
    ) -> None:
        """Take in a prediction.

        measured: its position and its yaw against odometry, (4,). size: variances (2,) expected of its position's and
        yaw's errors. way (3,), moved_m, drift (4,): odometry's step since the last one, its length with turns counted
        in, and usual variances. yaw, yaw_variance: the alignment's, as known before.
        """
        x, _, z = way.tolist()
        c, s = cos(yaw), sin(yaw)
        self._at += c * x + s * z, c * z - s * x
        bent = _COHERENT * min(yaw_variance, _MAX_YAW) * (x * x + z * z)
        self._since += moved_m, drift[0], drift[3], bent
        apart, turned = measured[[0, 2]] - self._at, measured[3:4]
        if not self._position.begun:
            self._position.begin(apart, float(size[0]))
            self._yaw.begin(turned, float(size[1]))
            self._since[:] = 0.0
            return
        metres, position, heading, bent = self._since.tolist()
        if metres < _EVERY_M:
            return
        self._position.update(apart, (position, bent), float(size[0]), metres)
        self._yaw.update(turned, (heading, 0.0), float(size[1]), metres)
        self._since[:] = 0.0
        position, position_size = self._position.factors(self.sizes_known)
        heading, yaw_size = self._yaw.factors(self.sizes_known)
        self.factors = np.array([position, position, position, heading])
        self.sizes = np.sqrt(np.repeat([yaw_size, position_size], 3))
        self.has_judged = True

    def save(self) -> list[Any]:
        """The state as plain data."""
        return [self._position.save(), self._yaw.save(), self.has_judged, *map(plain, self._arrays())]

    def restore(self, state: list[Any]) -> None:
        """Take over what `save` gave."""
        self._position.restore(state[0])
        self._yaw.restore(state[1])
        self.has_judged = state[2]
        self.factors, self.sizes, self._at, self._since = (np.array(part) for part in state[3:])

    def _arrays(self) -> tuple[Array, ...]:
        return self.factors, self.sizes, self._at, self._since
