"""How far off answers turn out to have been, and what their covariances are to be multiplied with for that.

Covariances assume how predictions are wrong together (likeness.py). Whether that holds for this regressor in this place
its newest predictions hardly tell; later ones do: some time after a pose was answered, predictions from farther on say
where it was. An error that these have in common with the answer isn't seen, so squared errors count as larger than they
seem."""

from collections import deque
from collections.abc import Iterator
from math import pi
from typing import Any, NamedTuple

import numpy as np

from groundwalk.fusion.methods.localiser import plain
from groundwalk.geometry.poses import Array

_APART_S = 0.5  # between two answers that are remembered, so that memory is bounded
_MOST = 50.0  # that a squared error counts as, over its variance: a few answers of another alignment aren't the rule
_SMALLEST = 1e-12


class Answered(NamedTuple):
    """An answer: its time, odometry's position (3,), the state (4,), x, y, z and yaw, and its covariance (4, 4)."""

    time_s: float
    vio: Array
    state: Array
    bound: Array


class Hindsight:
    """The answers that are too young to be judged, and what older ones have shown.

    `factors` (2,), of the variances of position and yaw: first those given, which count as `count` answers; `seen`
    (2,): what squared errors are multiplied with.
    """

    def __init__(self, age_s: float, factors: Array, count: float, seen: Array) -> None:
        self._age_s, self._seen = age_s, seen
        self._young: deque[Answered] = deque()
        self._count, self._sum = count, count * factors

    @property
    def widening(self) -> Array:
        """By what a covariance (4, 4) of x, y, z and yaw is to be multiplied, element by element."""
        sd = np.sqrt(self._sum / self._count)[[0, 0, 0, 1]]
        return np.outer(sd, sd)

    def remember(self, answered: Answered) -> None:
        """Take in what was just answered."""
        if not self._young or answered.time_s - self._young[-1].time_s >= _APART_S:
            self._young.append(answered)

    def old(self, time_s: float) -> Iterator[Answered]:
        """The answers that have become old enough to be judged; they are forgotten."""
        while self._young and time_s - self._young[0].time_s >= self._age_s:
            yield self._young.popleft()

    def judge(self, answered: Answered, state: Array) -> None:
        """Hold an answer against what is known of its state (4,) by now."""
        apart = state - answered.state
        position = apart[:3] @ np.linalg.solve(answered.bound[:3, :3], apart[:3]) / 3
        yaw = (apart[3] + pi) % (2 * pi) - pi
        squared = np.array([position, yaw**2 / max(answered.bound[3, 3], _SMALLEST)])
        self._sum = self._sum + self._seen * np.clip(squared, 0.0, _MOST)
        self._count += 1

    def save(self) -> list[Any]:
        """The state as plain data."""
        return [[[a.time_s, *map(plain, a[1:])] for a in self._young], plain(self._sum), self._count]

    def restore(self, state: list[Any]) -> None:
        """Take over what `save` gave."""
        self._young = deque(Answered(time_s, *map(np.array, arrays)) for time_s, *arrays in state[0])
        self._sum, self._count = np.array(state[1]), state[2]
