"""How well odometry holds, learnt from predictions alone: Kalman filters side by side, each of which supposes another
size of odometry's drift and of the predictions' errors, weighed by how well they predict.

Predictions that are wrong alike at a place look like drift for a while, and bad odometry looks like bad predictions.
What tells them apart is the long run: drift goes on growing, an error that neighbours share levels off. So only every
few metres a prediction is taken, and a hypothesis also says which share of its error the last one had in common with
it. Under each hypothesis odometry's offset and the shared error are two numbers an axis, which a Kalman filter with
the tails of Student's t follows. Nothing here hangs on the fit of the alignment but its yaw, so a fit that has gone
wrong doesn't confirm itself. How far a prediction leans against gravity, in which odometry hardly errs, tells from the
first one on how large its errors of yaw are."""

from math import cos, log, sin, sqrt

import numpy as np

from groundwalk.geometry.poses import Array

# Factors of the usual variance of drift, and of the expected one of a prediction's error; the share of that which
# neighbours have in common, and the metres that it reaches.
_SHARED = ((0.0, 1.0), (0.6, 4.0), (0.9, 16.0))
_DRIFT, _SIZE, _SHARE, _REACH_M = np.array(
    [(4.0**d, 8.0**s, *shared) for d in range(6) for s in range(-4, 4) for shared in _SHARED]
).T
_LOG_PRIOR = log(0.33) * np.log(_DRIFT) / log(4.0)  # odds of each further factor of drift
_NEAR = sqrt(2) * log(4.0)  # of the logarithm of height's factor about position's, one sigma
_SIZE_PRIOR = -((np.log(_SIZE) / log(2.0)) ** 2) / 2  # where covariances state it: a factor of two, one sigma
_DOF = 1.5  # of Student's t
_KEPT = 0.98  # of the evidence so far, with each prediction taken
_TILTS_KEPT = 0.9  # the same, of what they tell by leaning: turns about other axes may be better known than the yaw
_EVERY_M = 2.5  # motion between two predictions taken, turns counted in
_MIN_VARIANCE = 1e-10
_MAX_YAW = 0.01  # variance, rad^2, of the yaw that carries the way on: an unknown one would excuse any drift
_COHERENT = 2.0  # that yaw is wrong alike from step to step


def _log_likelihood(axes: int, squared: Array, variances: Array) -> Array:
    """Of errors along some axes under Student's t: the sum of their squares over the variances, which are alike."""
    return -axes / 2 * np.log(variances) - (_DOF + axes) / 2 * np.log1p(squared / _DOF)


class _Filters:
    """Those of `axes` numbers with the same variances, one a hypothesis."""

    def __init__(self, axes: int) -> None:
        self._offset, self._shared = np.zeros((axes, len(_DRIFT))), np.zeros((axes, len(_DRIFT)))
        self._P = np.zeros((3, len(_DRIFT)))  # variances of both, and their covariance
        self._log_odds = np.zeros(len(_DRIFT))

    def begin(self, apart: Array, size: float) -> None:
        """The first prediction of a frame of odometry's: `apart` (axes,) from where odometry's way begins."""
        usual = size * _SIZE
        self._offset[:], self._shared[:] = apart[:, None], 0.0
        self._P[:] = usual, _SHARE * usual, -_SHARE * usual

    def update(self, apart: Array, drift: float, added: float, size: float, moved_m: float) -> None:
        """Take in the next one. drift: the usual variance on the way, `added` to it anyhow. size: of the error."""
        axes, usual, faded = len(apart), size * _SIZE, np.exp(-moved_m / _REACH_M)
        P_a, P_b, P_ab = self._P
        P_a, P_b = P_a + _DRIFT * drift + added, faded**2 * (P_b - _SHARE * usual) + _SHARE * usual
        P_ab = faded * P_ab
        H_a, H_b, noise = P_a + P_ab, P_b + P_ab, (1 - _SHARE) * usual
        S = H_a + H_b + noise
        self._shared *= faded
        error = apart[:, None] - self._offset - self._shared
        squared = (error**2).sum(axis=0) / S
        self._log_odds = _KEPT * self._log_odds + _log_likelihood(axes, squared, S)
        self._log_odds -= self._log_odds.max()
        S = H_a + H_b + noise * np.maximum(1.0, (_DOF + squared) / (_DOF + axes)) + _MIN_VARIANCE
        self._offset += H_a / S * error
        self._shared += H_b / S * error
        self._P[:] = P_a - H_a**2 / S, P_b - H_b**2 / S, P_ab - H_a * H_b / S

    def factors(self, sizes_known: bool, near: float | None = None, other: Array | float = 0.0) -> tuple[float, float]:
        """Of the usual variances of drift and of a prediction's error: means of their logarithms over hypotheses. near:
        what drift's factor is expected to be, where that isn't 1. other: evidence (log odds) from elsewhere."""
        log_prior = _LOG_PRIOR if near is None else -((np.log(_DRIFT / near) / _NEAR) ** 2) / 2
        odds = self._log_odds + log_prior + other
        odds = np.exp(odds - odds.max() + (_SIZE_PRIOR if sizes_known else 0.0))
        odds /= odds.sum()
        return float(np.exp(odds @ np.log(_DRIFT))), float(np.exp(odds @ np.log(_SIZE)))


class OdometryQuality:
    """Fed with each prediction; `factors` (4,) are of the usual variances of drift in x, y, z and yaw, `sizes` (6,) of
    the expected sizes of predictions' errors. lean_variance: of odometry's vertical against the map's, an axis."""

    def __init__(self, lean_variance: float) -> None:
        self._lean_variance = lean_variance
        self._tilts = np.zeros(len(_SIZE))  # what predictions' lean tells of the sizes of their errors of yaw
        self._position, self._height, self._yaw = _Filters(2), _Filters(1), _Filters(1)
        self.factors, self.sizes = np.ones(4), np.ones(6)
        self.is_known = False
        # The next prediction may be of another place, or odometry have lost its frame: neither tells of its drift.
        self.paused = False
        self.lost()

    def lost(self) -> None:
        """Odometry has lost its frame, or may have: its offset is unknown again, its quality isn't."""
        self._begun = False  # a prediction has been taken in this frame of odometry's
        self._at = np.zeros(3)  # where odometry's way has come to in the map, begun anywhere
        # Since the last prediction taken: metres, usual drift of position, height and yaw, and what yaw adds.
        self._since = np.zeros(5)

    def update(
        self,
        measured: Array,
        size: tuple[float, float],
        step: Array,
        moved_m: float,
        drift: Array,
        yaw: tuple[float, float],
        sizes_known: bool,
    ) -> None:
        """Take in a prediction.

        measured: its position, its yaw against odometry and its tilt, (6,). size: variances expected of its position's
        and yaw's errors; sizes_known: they were stated. step (3,), moved_m, drift (4,): odometry's since the last one,
        its length with turns counted in, and usual variances. yaw: the alignment's, and its variance, as known before.
        """
        x, y, z = step.tolist()
        c, s = cos(yaw[0]), sin(yaw[0])
        self._at += c * x + s * z, y, c * z - s * x
        self._since += moved_m, drift[0], drift[1], drift[3], _COHERENT * min(yaw[1], _MAX_YAW) * (x * x + z * z)
        apart, turned = measured[:3] - self._at, measured[3:4]
        tilt, of_tilt = measured[4:], size[1] * _SIZE + self._lean_variance
        self._tilts = _TILTS_KEPT * self._tilts + _log_likelihood(2, tilt @ tilt / of_tilt, of_tilt)
        if not self._begun:
            self._begun = True
            self._position.begin(apart[::2], size[0])
            self._height.begin(apart[1:2], size[0])
            self._yaw.begin(turned, size[1])
            self._since[:] = 0.0
        elif self._since[0] >= _EVERY_M and not self.paused:
            metres, position, height, heading, added = self._since.tolist()
            self._position.update(apart[::2], position, added, size[0], metres)
            self._height.update(apart[1:2], height, 0.0, size[0], metres)
            self._yaw.update(turned, heading, 0.0, size[1], metres)
            self._since[:] = 0.0
            position, position_size = self._position.factors(sizes_known)
            height, _ = self._height.factors(sizes_known, position)
            heading, yaw_size = self._yaw.factors(sizes_known, other=self._tilts)
            self.factors = np.array([position, height, position, heading])
            self.sizes = np.sqrt(np.repeat([yaw_size, position_size], 3))
            self.is_known = True
