"""How far off estimates turn out to have been, and what their covariances are to be multiplied with for that.

Covariances assume how predictions' errors are correlated (prediction_errors.py). Whether that holds for this regressor
in this place its newest predictions hardly tell; later ones do: some time after a pose was estimated, predictions from
farther on say where it was. The squared errors over their variances (NEES) are averaged. An error that later estimates
have in common with the earlier one isn't seen, so squared errors count as larger than they seem."""

from collections import deque
from collections.abc import Iterator
from math import pi

import numpy as np

from groundwalk.geometry.poses import Array

_AGE_S = 15.0  # of an estimate that is compared
_FIRST = np.array([1.0, 0.8])  # factors before that, of the variances of position and yaw, ...
_COUNT = 3.0  # ... and estimates that they count as
_SEEN = np.array(
    [5.0, 1.6]
)  # what squared errors of either are multiplied with, for what later estimates share of them
_APART_S = 0.5  # between two estimates that are remembered, so that memory is bounded
_MOST = 50.0  # that a squared error counts as, over its variance: a few estimates of another alignment aren't the rule
_SMALLEST = 1e-12


Past = tuple[float, Array, Array, Array]
"""An estimate: its time (s), odometry's position (3,), the state (4,), x, y, z and yaw, and its covariance (4, 4)."""


class Calibration:
    """The estimates that are too young to be compared, and what older ones have shown."""

    def __init__(self) -> None:
        self._pending: deque[Past] = deque()
        self._count, self._sum = _COUNT, _COUNT * _FIRST

    @property
    def inflation(self) -> Array:
        """By what a covariance (4, 4) of x, y, z and yaw is to be multiplied, element by element."""
        sd = np.sqrt(self._sum / self._count)[[0, 0, 0, 1]]
        return np.outer(sd, sd)

    def remember(self, past: Past) -> None:
        """Take in the newest estimate."""
        if not self._pending or past[0] - self._pending[-1][0] >= _APART_S:
            self._pending.append(past)

    def due(self, time_s: float) -> Iterator[Past]:
        """The estimates that have become old enough to be compared; they are forgotten."""
        while self._pending and time_s - self._pending[0][0] >= _AGE_S:
            yield self._pending.popleft()

    def compare(self, past: Array, bound: Array, state: Array) -> None:
        """Hold an estimate, its state (4,) and covariance (4, 4), against what is known of its state (4,) by now."""
        apart = state - past
        position = apart[:3] @ np.linalg.solve(bound[:3, :3], apart[:3]) / 3
        yaw = (apart[3] + pi) % (2 * pi) - pi
        squared = np.array([position, yaw**2 / max(bound[3, 3], _SMALLEST)])
        self._sum = self._sum + _SEEN * np.clip(squared, 0.0, _MOST)
        self._count += 1
