"""Poses, averages, fits: pure functions on arrays, no files.

A pose is a 4x4 float64 matrix named by its frames: ``map_T_cam`` takes camera coordinates to map coordinates.
Batches have leading axes. Quaternions are xyzw, unit, w >= 0. Angles are radians unless the name says ``_deg``.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class GeometryError(ValueError):
    """An input for which the asked quantity isn't defined; the message holds the numbers that made it fail."""
