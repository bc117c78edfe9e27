"""Predictions kept as evidence, in bounded memory: a table of keyframes that is thinned where it is densest.

A keyframe is a prediction with what odometry said of the way to it. When the table is full, the one that says least
goes: whose neighbours are nearest to each other in motion, for the time that has passed since. So the newest are kept
as they came, older ones ever farther apart."""

from math import cos, sin
from typing import Any

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import Rows, compiled
from groundwalk.fusion.methods.estimator.odometry_step import CERTAIN

KEYFRAME = np.dtype(
    [
        ("whitening", float, (6, 6)),  # B: from odometry's axes to normalised errors in camera axes
        ("measured", float, 6),  # predicted position (m), yaw against odometry, tilt about the map's x and z (rad)
        ("vio", float, 3),  # odometry's position
        ("forward", float, 3),  # where the camera looks, in odometry's axes
        ("step", float, 3),  # odometry's step from the keyframe before, in its axes there
        ("turn", float),  # what odometry's axes have turned by since: its frame was lost, and bridged (rad)
        ("drift", float, 4),  # variances that odometry's drift adds on the way from the keyframe before: x, y, z, yaw
        ("added_variance", float, 4),  # what a loss of its frame adds to them
        ("bridged", float, 3),  # the step where odometry has jumped, in the same axes
        ("moved", float, 3),  # the step where it hasn't
        ("bridge", float, 4),  # what bridging adds to the variances where it has jumped
        ("odds", float),  # logarithm of the odds beforehand that it has (odometry_step.py)
        ("state", float, 4),  # the camera's map position and the yaw of map_R_vio, as estimated
        ("posterior", float, (4, 4)),  # covariance of the state, turned back by the yaw, as it was an iteration ago
        ("along", float),  # motion since the start
        ("time_s", float),
        ("segment", float),  # counts up where odometry lost its frame, or may have
        ("kept_odds", float),  # logarithm of the odds against that, before the keyframe
    ]
)


class Keyframes:
    """The table. `rows` is a view of what is in use, which writing to changes."""

    def __init__(self, capacity: int | None) -> None:
        """`capacity`: how many are kept; all where None."""
        self.capacity = capacity
        self._rows = np.zeros((capacity or 64) + 1, dtype=KEYFRAME)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Rows:
        """The keyframes in use."""
        return self._rows[: self._count]

    def add(self, **values: Any) -> None:
        """Put one at the end; where the table is full, another one goes."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        row = self._rows[self._count]
        for name, value in values.items():
            row[name] = value
        self._count += 1
        if self.capacity is not None and self._count > self.capacity:
            self.remove(_least(self.rows))

    def remove(self, index: int) -> None:
        """Take one out; the way to the next one is then the way over it."""
        _close(self.rows, index)
        self._count -= 1


@compiled
def _least(keyframes: Rows) -> int:
    """Which keyframe says least."""
    least, index = np.inf, 0
    for i in range(1, len(keyframes) - 1):
        before, here, after = keyframes[i - 1], keyframes[i], keyframes[i + 1]
        apart = after.along - before.along + 1e-6 * (after.time_s - before.time_s)
        # As far apart as they are far back, so that the table reaches far back with few.
        apart /= keyframes[-1].along - here.along + 1.0
        if apart < least:
            least, index = apart, i
    return index


@compiled
def _close(keyframes: Rows, index: int) -> None:
    """Move the keyframes after one up over it."""
    last = len(keyframes) - 1
    if index < last:
        gone, after = keyframes[index], keyframes[index + 1]
        c, s = cos(gone.turn), sin(gone.turn)
        x, z = after.step[0], after.step[2]
        # What the yaw has drifted on the first way takes the second one aside, and the first by half as much.
        aside = max(x * x + z * z + gone.step[0] * x + gone.step[2] * z, 0.0) * gone.drift[3] / 2
        after.drift[0] += aside
        after.drift[2] += aside
        after.step[0] = gone.step[0] + (c * x + s * z)
        after.step[1] += gone.step[1]
        after.step[2] = gone.step[2] + (c * z - s * x)
        after.turn += gone.turn
        after.odds = CERTAIN
        for j in range(4):
            after.drift[j] += gone.drift[j]
            after.added_variance[j] += gone.added_variance[j]
        if after.segment == gone.segment:
            after.kept_odds = min(after.kept_odds, gone.kept_odds)
    for i in range(index, last):
        keyframes[i] = keyframes[i + 1]
