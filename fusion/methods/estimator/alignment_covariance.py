"""How far off the fitted alignment may be.

The fit takes predictions for independent ones that count less. What it is worth hangs on how their errors are really
correlated (error_correlation.py). The covariance is that of the fit's linear response to such errors (a sandwich, as
of generalised estimating equations; Liang and Zeger, Biometrika 73, 1986)."""

from math import cos, sin, sqrt

import numpy as np

from groundwalk.fusion.methods.estimator.chain import UNKNOWN, covariances_with
from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.fit import Fit
from groundwalk.fusion.methods.estimator.keyframes import Rows
from groundwalk.fusion.methods.estimator.matrices import add_product, clear, invert, write_columns
from groundwalk.geometry.poses import Array


@compiled
def alignment_covariance(keyframes: Rows, fit: Fit, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    answer = covariances_with(fit.solution, index)  # of keyframe i's gradient to the increments
    moved = _moved(keyframes, fit, answer)
    precision, covariance = fit.covariance.copy(), answer[index].copy()
    invert(precision)
    believed, together, weighed = np.empty((4, 4)), np.empty((6, 4)), np.empty((6, 4))
    for i in range(len(keyframes)):
        clear(believed, 4, 4)
        add_product(fit.information[i], answer[i], believed, (4, 4, 4))
        add_product(answer[i].T, believed, covariance, (4, 4, 4), -1.0)
        _write_together(moved, fit.correlation[i], i, together)
        clear(weighed, 6, 4)
        add_product(precision, together, weighed, (6, 6, 4))
        add_product(moved[i].T, weighed, covariance, (4, 6, 4))
    symmetric = np.empty((4, 4))
    for j in range(4):
        for k in range(4):
            symmetric[j, k] = (covariance[j, k] + covariance[k, j]) / 2
    return turned(symmetric, keyframes[index].state[3])


@compiled
def _moved(keyframes: Rows, fit: Fit, answer: Array) -> Array:
    """What an error of each of a prediction's six numbers does to the answer, (N, 6, 4), over its size."""
    unknown, moved = np.empty((6, 4)), np.zeros((len(keyframes), 6, 4))
    for i in range(len(keyframes)):
        write_columns(keyframes[i].whitening, UNKNOWN, unknown, 6)
        add_product(unknown, answer[i], moved[i], (6, 4, 4), fit.effective[i] * sqrt(fit.weights[i]))
    return moved


@compiled
def _write_together(moved: Array, correlation: Array, i: int, together: Array) -> None:
    """Writes what one keyframe's error moves, (6, 4), with what those before it move that are correlated with it, (N,).
    These count twice, as each pair is met once."""
    for k in range(6):
        for m in range(4):
            together[k, m] = moved[i, k, m]
    for j in range(i):
        if correlation[j] > 0:
            for k in range(6):
                for m in range(4):
                    together[k, m] += 2 * correlation[j] * moved[j, k, m]


@compiled
def turned(covariance: Array, yaw: float) -> Array:
    """A covariance (4, 4) of x, y, z and yaw in axes turned forth by a yaw (rad)."""
    c, s = cos(yaw), sin(yaw)
    half, result = np.empty((4, 4)), np.empty((4, 4))
    for j in range(4):
        half[0, j] = c * covariance[0, j] + s * covariance[2, j]
        half[1, j] = covariance[1, j]
        half[2, j] = c * covariance[2, j] - s * covariance[0, j]
        half[3, j] = covariance[3, j]
    for j in range(4):
        result[j, 0] = c * half[j, 0] + s * half[j, 2]
        result[j, 1] = half[j, 1]
        result[j, 2] = c * half[j, 2] - s * half[j, 0]
        result[j, 3] = half[j, 3]
    return result
