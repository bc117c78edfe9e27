"""How far off the fitted alignment may be: a covariance that errors alike in neighbouring predictions don't fool."""

import numpy as np

from fusion.aligner import Fit, Model
from fusion.keyframes import Keyframes
from geometry.poses import Array, yaw_rotation

_LAGS = 8


def alignment_covariance(keyframes: Keyframes, fit: Fit, model: Model, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    covariance = fit.solution.covariance_columns(index)[index]
    turn = np.eye(4)
    turn[:3, :3] = yaw_rotation(keyframes.column("state")[index, 3])
    return np.asarray(turn @ covariance @ turn.T)
