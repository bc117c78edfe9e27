"""Odometry's way since the newest keyframe, and what it may be instead where odometry seems to have jumped.

A phone goes on moving as it did while its odometry jumps: across a jump the step is that of its velocity before, and
either odometry's heading holds, or, where it turned faster than a phone can, the camera's. A step that is merely long
may as well be true, as people run: then both ways are kept, and the predictions that follow tell which it was
(fit.py)."""

from math import atan2, cos, exp, sin

import numpy as np

from groundwalk.geometry.poses import Array

CERTAIN = 100.0  # log odds of what is known: that it has jumped, where it turned as no phone does, or that it hasn't
_UNLIKE = 2.0  # standard deviations of a step from that of the velocity before, within which it is no jump


class OdometryStep:
    """`turn`: what odometry's axes have turned by since the newest keyframe, rad. `added_variance` (4,): what bridging
    adds to the variances of x, y, z and yaw. `odds`: logarithm of the odds that odometry has jumped, against its having
    moved so."""

    def __init__(self) -> None:
        self._velocity = [0.0, 0.0, 0.0]  # m/s, in odometry's axes now
        self.begin(np.zeros(3))

    def begin(self, vio_position: Array) -> None:
        """Count from a keyframe on, at odometry's position (3,)."""
        self.turn, self.odds = 0.0, -CERTAIN
        self.added_variance = np.zeros(4)
        self._step = [0.0, 0.0, 0.0]  # up to the last bridge, in the keyframe's axes
        self._moved = [0.0, 0.0, 0.0]  # the same, as odometry has it
        self._from = vio_position.tolist()

    def go(self, step: list[float], seconds: float) -> None:
        """Take note of a step (3,) within one frame of odometry's."""
        if seconds > 0:
            self._velocity = [metres / seconds for metres in step]

    def is_unlike(self, step: list[float], seconds: float, sd_m_s: float) -> bool:
        """Whether a step (3,) isn't what the phone's velocity before lets one expect."""
        off = sum((d - seconds * v) ** 2 for d, v in zip(step, self._velocity, strict=True))
        return off > (_UNLIKE * sd_m_s * seconds) ** 2

    def bridge(
        self, before: Array, after: Array, seconds: float, turned: bool, sds: tuple[float, float]
    ) -> list[float]:
        """Odometry's pose (4, 4) has jumped. turned: the camera's heading holds, not odometry's. sds: how far step (m)
        and heading (rad) may be off. Returns the step that is taken to have been."""
        moved = [seconds * v for v in self._velocity]
        # Of the frame now against the frame before, so that the camera's heading stays.
        turn = -_yaw(after[:3, :3] @ before[:3, :3].T) if turned else 0.0
        displacement = [a - b for a, b in zip(after[:3, 3].tolist(), before[:3, 3].tolist(), strict=True)]
        step, by_odometry = self.bridged(before[:3, 3]), self.moved(before[:3, 3])
        self._step = (np.array(step) + _turned(self.turn, moved)).tolist()
        self._moved = (np.array(by_odometry) + _turned(self.turn, displacement)).tolist()
        self._from = after[:3, 3].tolist()
        self.turn += turn
        if turned:
            self._velocity, self.odds = _turned(-turn, self._velocity), CERTAIN
        else:
            self.go(displacement, seconds)
            self.odds = max(self.odds, 0.0)
        self.added_variance = self.added_variance + np.square([sds[0], sds[0], sds[0], sds[1]])
        return moved

    def bridged(self, vio_position: Array) -> list[float]:
        """The step (3,) from the newest keyframe to odometry's position (3,), in odometry's axes there, its jumps
        bridged."""
        return self._since(self._step, vio_position)

    def moved(self, vio_position: Array) -> list[float]:
        """The same as odometry has it."""
        return self._since(self._moved, vio_position)

    def step(self, vio_position: Array) -> list[float]:
        """The same, as is to be expected."""
        pairs = zip(self.bridged(vio_position), self.moved(vio_position), strict=True)
        return [self.jump * b + (1 - self.jump) * m for b, m in pairs]

    @property
    def jump(self) -> float:
        """The probability that odometry has jumped."""
        return 1 / (1 + exp(-self.odds))

    @property
    def added(self) -> Array:
        """What not knowing that adds to the variances of x, y, z and yaw, (4,)."""
        apart = float(np.sum((np.array(self._step) - self._moved) ** 2)) / 3
        return self.jump * self.added_variance + self.jump * (1 - self.jump) * apart * np.array([1.0, 1.0, 1.0, 0.0])

    def _since(self, step: list[float], vio_position: Array) -> list[float]:
        now = vio_position.tolist()
        since = _turned(self.turn, [now[i] - self._from[i] for i in range(3)])
        return [step[i] + since[i] for i in range(3)]


def _turned(yaw: float, step: list[float]) -> list[float]:
    c, s = cos(yaw), sin(yaw)
    x, y, z = step
    return [c * x + s * z, y, c * z - s * x]


def _yaw(rotation: Array) -> float:
    """The yaw (rad) nearest to a rotation (3, 3)."""
    return atan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
