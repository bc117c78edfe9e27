"""Predictions kept as evidence, in bounded memory: a table of keyframes that is thinned where it is densest.

A keyframe is a prediction with what odometry said of the way to it. When the table is full, the one that says least
goes: whose neighbours are nearest to each other in motion, for the time that has passed since. So the newest are kept
as they came, older ones ever farther apart."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from groundwalk.geometry.poses import Array, yaw_rotation

# Columns of the table, by what they hold.
_WIDTHS = {
    "whitening": 36,  # B (6, 6): from odometry's axes to normalised errors in camera axes
    "measured": 6,  # predicted position (m), yaw against odometry, tilt about the map's x and z (rad)
    "vio": 3,  # odometry's position
    "step": 3,  # odometry's step from the keyframe before, in its axes there
    "turn": 1,  # what odometry's axes have turned by since: its frame was lost, and bridged (rad)
    "drift": 4,  # variances that odometry's drift adds on the way from the keyframe before: x, y, z, yaw
    "loose": 4,  # what a loss of its frame adds to them
    "state": 4,  # the camera's map position and the yaw of map_R_vio, as estimated
    "posterior": 16,  # covariance (4, 4) of the state, in axes turned back by the yaw, as it was `age` iterations ago
    "age": 1,
    "along": 1,  # motion since the start
    "time_s": 1,
    "segment": 1,  # counts up where odometry lost its frame, or may have
    "rare": 1,  # logarithm of the odds against that, before the keyframe
}
_COLUMNS = {}
_width = 0
for _name, _count in _WIDTHS.items():
    _COLUMNS[_name] = slice(_width, _width + _count)
    _width += _count


class Keyframes:
    """The table. Attributes are views of the rows in use, which writing to changes."""

    def __init__(self, capacity: int | None) -> None:
        """`capacity`: how many are kept; None keeps all."""
        self.capacity = capacity
        self._rows = np.zeros((64 if capacity is None else capacity + 1, _width))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def column(self, name: str) -> Array:
        """A view (N, width) of what the keyframes hold of one kind, (N,) where it is one number."""
        view = self._rows[: self._count, _COLUMNS[name]]
        return view[:, 0] if _WIDTHS[name] == 1 else view

    def add(self, **values: Any) -> None:
        """Put one at the end; where the table is full, another one goes."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        row = self._rows[self._count]
        for name, value in values.items():
            row[_COLUMNS[name]] = np.ravel(value)
        self._count += 1
        if self.capacity is not None and self._count > self.capacity:
            self.remove(self._least())

    def remove(self, index: int) -> None:
        """Take one out; the way to the next one is then the way over it."""
        if index + 1 < self._count:
            before, after = self._rows[index], self._rows[index + 1]
            step, turn = _COLUMNS["step"], _COLUMNS["turn"]
            after[step] = before[step] + yaw_rotation(float(before[turn][0])) @ after[step]
            for name in ("turn", "drift", "loose"):
                after[_COLUMNS[name]] += before[_COLUMNS[name]]
            if after[_COLUMNS["segment"]] == before[_COLUMNS["segment"]]:
                after[_COLUMNS["rare"]] = min(after[_COLUMNS["rare"]], before[_COLUMNS["rare"]])
        self._rows[index : self._count - 1] = self._rows[index + 1 : self._count]
        self._count -= 1

    def keep(self, rows: Sequence[int] | Array) -> None:
        """Drop all but these rows (rising)."""
        gone = np.setdiff1d(np.arange(self._count), rows)
        for index in gone[::-1]:
            self.remove(int(index))

    def _least(self) -> int:
        along, time_s = self.column("along"), self.column("time_s")
        apart = along[2:] - along[:-2] + 1e-6 * (time_s[2:] - time_s[:-2])
        # As far apart as they are far back, so that the table reaches far back with few.
        back = along[-1] - along[1:-1] + 1.0
        return 1 + int(np.argmin(apart / back)) if len(apart) else 0

    def save(self) -> list[list[float]]:
        """The rows as plain lists."""
        return self._rows[: self._count].tolist()

    def restore(self, rows: list[list[float]]) -> None:
        """Take over rows that `save` gave."""
        self._count = 0
        if rows:
            table = np.array(rows)
            self._rows = np.zeros((max(len(self._rows), len(table)), _width))
            self._rows[: len(table)] = table
            self._count = len(table)
