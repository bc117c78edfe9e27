"""How far off the fitted alignment may be.

The fit takes predictions for independent ones that count less. What its answer is worth hangs on how they are really
wrong together: predictions near each other share a part of their error, wherever on the walk they were made. With that
part the covariance is that of the fit's linear answer to such errors (a sandwich, as of generalised estimating
equations; Liang and Zeger, Biometrika 73, 1986)."""

from math import cos, sin

import numpy as np

from groundwalk.fusion.methods.estimator.aligner import Fit, Model
from groundwalk.fusion.methods.estimator.alignment_chain import UNKNOWN
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.geometry.poses import Array


def alignment_covariance(keyframes: Keyframes, fit: Fit, model: Model, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    count = len(keyframes)
    flat = fit.solution.columns(np.array([index]))
    answer = flat.reshape(count, 4, 4)  # of keyframe i's gradient to the increments
    believed = flat.T @ (fit.information @ answer).reshape(-1, 4)
    # What one standard deviation of each of a prediction's six numbers does to the answer.
    unknown = keyframes.column("whitening").reshape(count, 6, 6)[:, :, UNKNOWN]
    moved = np.linalg.inv(np.linalg.cholesky(fit.covariance)) @ (unknown @ answer)
    moved *= np.sqrt(fit.counted * fit.weights)[:, None, None]
    place = keyframes.column("state")[:, :3]
    apart = place[:, None] - place
    alike = model.shared * np.exp(np.sqrt((apart * apart) @ np.ones(3)) / -model.shared_m)
    alike.flat[:: count + 1] = 1.0
    together = (alike @ moved.reshape(count, -1)).reshape(-1, 4)
    real = moved.reshape(-1, 4).T @ together
    return turned(answer[index] - believed + real, keyframes.column("state")[index, 3])


def turned(covariance: Array, yaw: float) -> Array:
    """A covariance (4, 4) of x, y, z and yaw in axes turned forth by a yaw (rad)."""
    c, s = cos(yaw), sin(yaw)
    turn = np.array([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return np.asarray(turn @ covariance @ turn.T)
