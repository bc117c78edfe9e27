"""How far VIO may drift over a path: the one model that pairs, models and ground truth are checked by.

It is well above what phones were measured to drift by, as a tighter limit would refuse good poses for bad VIO
(docs/explanation/vio-drift.md).
"""

import numpy as np
from numpy.typing import ArrayLike

from groundwalk.geometry.poses import Array

# Of positions, as VIO's scale and heading are off: metres, and metres a metre of path.
DRIFT_M, DRIFT_M_PER_M = 0.1, 0.03
# Of rotations, a random walk with the error of two images in the constant: radians, and radians a root of a metre.
_RAD, _RAD_PER_SQRT_M = float(np.radians(3.0)), float(np.radians(2.5))


def drift_m(path_m: ArrayLike) -> Array:
    """Metres by which positions may be off over paths (...) in metres."""
    return np.asarray(DRIFT_M + DRIFT_M_PER_M * np.asarray(path_m, dtype=float))


def drift_rad(path_m: ArrayLike) -> Array:
    """Radians by which rotations may be off over paths (...) in metres."""
    return np.asarray(_RAD + _RAD_PER_SQRT_M * np.sqrt(np.asarray(path_m, dtype=float)))
