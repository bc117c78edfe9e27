"""How far off the fitted alignment may be.

The fit's own covariance knows of noise that averages out, of drift, and, by what a prediction counts, of neighbours
that are wrong alike. It doesn't know that a regressor may misplace a whole walk the same way. That part of a
prediction's position error, a share of its covariance, is added: no number of predictions takes it away."""

from math import cos, sin

import numpy as np

from groundwalk.fusion.aligner import Fit, Model
from groundwalk.fusion.alignment_chain import UNKNOWN
from groundwalk.fusion.keyframes import Keyframes
from groundwalk.geometry.poses import Array


def alignment_covariance(keyframes: Keyframes, fit: Fit, model: Model, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    found = fit.solution.covariance(index)
    back = np.linalg.inv(keyframes.column("whitening")[index].reshape(6, 6))[UNKNOWN]
    found[:3, :3] += model.shared * (back @ fit.covariance @ back.T)[:3, :3]
    return turned(found, keyframes.column("state")[index, 3])


def turned(covariance: Array, yaw: float) -> Array:
    """A covariance (4, 4) of x, y, z and yaw in axes turned forth by a yaw (rad)."""
    c, s = cos(yaw), sin(yaw)
    turn = np.array([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(turn @ covariance @ turn.T)
