"""How far off the fitted alignment may be.

The fit's own covariance knows of noise that averages out, of drift, and, by what a prediction counts, of neighbours that
are wrong alike. It doesn't know that a regressor may misplace a whole walk the same way. That part of a prediction's position
error, a share of its covariance, is added: no number of predictions takes it away.
"""

import numpy as np

from fusion.aligner import Fit, Model
from fusion.alignment_chain import UNKNOWN
from fusion.keyframes import Keyframes
from geometry.poses import Array, yaw_rotation


def alignment_covariance(keyframes: Keyframes, fit: Fit, model: Model, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    found = fit.solution.covariance_columns(index)[index]
    back = np.linalg.inv(keyframes.column("whitening")[index].reshape(6, 6))[UNKNOWN]
    found = found.copy()
    found[:3, :3] += model.shared * (back @ fit.covariance @ back.T)[:3, :3]
    turn = np.eye(4)
    turn[:3, :3] = yaw_rotation(keyframes.column("state")[index, 3])
    return np.asarray(turn @ found @ turn.T)
