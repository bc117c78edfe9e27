"""How far VIO may drift: the one model that pairs, models and ground truth are checked by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from groundwalk.geometry.poses import Array


@dataclass(frozen=True)
class VioDrift:
    """The error that VIO may have over a path of s metres.

    Position `m` + `m_per_m` s, metres: its scale and heading are off. Rotation `rad` + `rad_per_sqrt_m` sqrt(s),
    radians: a random walk, with the error of two images in the constant.
    """

    m: float
    m_per_m: float
    rad: float
    rad_per_sqrt_m: float

    @classmethod
    def in_degrees(cls, m: float, m_per_m: float, deg: float, deg_per_sqrt_m: float) -> "VioDrift":
        """The same with rotations in degrees, as settings have them."""
        return cls(m, m_per_m, float(np.radians(deg)), float(np.radians(deg_per_sqrt_m)))

    def metres(self, path_m: ArrayLike) -> Array:
        """Metres allowed over paths (...) in metres."""
        return np.asarray(self.m + self.m_per_m * np.asarray(path_m, dtype=float))

    def radians(self, path_m: ArrayLike) -> Array:
        """Radians allowed over paths (...) in metres."""
        return np.asarray(self.rad + self.rad_per_sqrt_m * np.sqrt(np.asarray(path_m, dtype=float)))


VIO_DRIFT = VioDrift.in_degrees(m=0.1, m_per_m=0.03, deg=3.0, deg_per_sqrt_m=2.5)
"""What all checks allow: well above what phones were measured to drift by, as a tighter limit would refuse good poses
for bad VIO (docs/explanation/vio-drift.md)."""
