"""Odometry's way since the newest keyframe, bridged where odometry has lost its frame.

A phone goes on moving as it did while its odometry jumps: across a jump the step is that of its velocity before, and
either odometry's heading holds, or, where it turned faster than a phone can, the camera's. How far both may be off is
added to what the way leaves uncertain."""

from math import atan2, cos, sin
from typing import Any

import numpy as np

from groundwalk.fusion.methods.localiser import plain
from groundwalk.geometry.poses import Array


class Way:
    """`turn`: what odometry's axes have turned by since the newest keyframe, rad. `loose` (4,): what bridging adds to
    the variances of x, y, z and yaw."""

    def __init__(self) -> None:
        self._velocity = [0.0, 0.0, 0.0]  # m/s, in odometry's axes now
        self.begin(np.zeros(3))

    def begin(self, vio_position: Array) -> None:
        """Count from a keyframe on, at odometry's position (3,)."""
        self.turn = 0.0
        self.loose = np.zeros(4)
        self._step = [0.0, 0.0, 0.0]  # up to the last bridge, in the keyframe's axes
        self._from = vio_position.tolist()

    def go(self, step: list[float], seconds: float) -> None:
        """Take note of a step (3,) within one frame of odometry's."""
        if seconds > 0:
            self._velocity = [metres / seconds for metres in step]

    def bridge(
        self, before: Array, after: Array, seconds: float, turned: bool, sd_m: float, sd_rad: float
    ) -> list[float]:
        """Odometry's pose (4, 4) has jumped. turned: the camera's heading holds, not odometry's. sd_m, sd_rad: how far
        step and heading may be off. Returns the step that is taken to have been."""
        moved = [seconds * v for v in self._velocity]
        # Of the frame now against the frame before, so that the camera's heading stays.
        turn = -_yaw(after[:3, :3] @ before[:3, :3].T) if turned else 0.0
        self._step = (np.array(self.step(before[:3, 3])) + _turned(self.turn, moved)).tolist()
        self._from = after[:3, 3].tolist()
        self.turn += turn
        self._velocity = _turned(-turn, self._velocity)
        self.loose = self.loose + np.array([sd_m**2, sd_m**2, sd_m**2, sd_rad**2])
        return moved

    def step(self, vio_position: Array) -> list[float]:
        """The step (3,) from the newest keyframe to odometry's position (3,), in odometry's axes there."""
        now = vio_position.tolist()
        since = _turned(self.turn, [now[i] - self._from[i] for i in range(3)])
        return [self._step[i] + since[i] for i in range(3)]

    def save(self) -> list[Any]:
        """The state as plain data."""
        return [self.turn, plain(self.loose), self._step, self._from, self._velocity]

    def restore(self, state: list[Any]) -> None:
        """Take over what `save` gave."""
        self.turn, self.loose = state[0], np.array(state[1])
        self._step, self._from, self._velocity = (list(part) for part in state[2:])


def _turned(yaw: float, step: list[float]) -> list[float]:
    c, s = cos(yaw), sin(yaw)
    x, y, z = step
    return [c * x + s * z, y, c * z - s * x]


def _yaw(rotation: Array) -> float:
    """The yaw (rad) nearest to a rotation (3, 3)."""
    return atan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
