"""How far off the fitted alignment may be.

The fit takes predictions for independent ones that count less. What its answer is worth hangs on how they are really
wrong together: predictions of one place share a part of their error, as long as they look the same way. That holds as
far as the regressor's errors are large: those of PoseNet and MS-Transformer fade over 0.3 m where they are 0.1 m
(chess) and over 6 m where they are 1 m (KingsCollege), and with 40 degrees in either. The covariance is that of the
fit's linear answer to such errors (a sandwich, as of generalised estimating equations; Liang and Zeger, Biometrika 73,
1986)."""

from math import cos, exp, log, sin, sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator.aligner import Fit
from groundwalk.fusion.methods.estimator.alignment_chain import UNKNOWN, covariances_with
from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.keyframes import Rows
from groundwalk.fusion.methods.estimator.matrices import add_product, clear, invert, write_columns
from groundwalk.fusion.methods.estimator.odometry_quality import expected_variances
from groundwalk.geometry.poses import Array

_ALIKE = 1e-3  # correlation below which errors are independent


class Sharing(NamedTuple):
    """What predictions have in common.

    share: of their errors' variance, at one place. sizes: how far apart they are where that has faded to 1/e, over the
    standard deviation of their position an axis. turn: the turn of the view by which it has faded to 1/sqrt(e), rad.
    """

    share: float
    sizes: float
    turn: float


@compiled
def alignment_covariance(keyframes: Rows, fit: Fit, sharing: Sharing, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes."""
    answer = covariances_with(fit.solution, index)  # of keyframe i's gradient to the increments
    moved, alike = _moved(keyframes, fit, answer), _alike(keyframes, fit, sharing, index)
    precision, covariance = fit.covariance.copy(), answer[index].copy()
    invert(precision)
    believed, together, weighed = np.empty((4, 4)), np.empty((6, 4)), np.empty((6, 4))
    for i in range(len(keyframes)):
        clear(believed, 4, 4)
        add_product(fit.information[i], answer[i], believed, (4, 4, 4))
        add_product(answer[i].T, believed, covariance, (4, 4, 4), -1.0)
        _write_together(moved, alike[i], i, together)
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
        add_product(unknown, answer[i], moved[i], (6, 4, 4), fit.counted[i] * sqrt(fit.weights[i]))
    return moved


@compiled
def _alike(keyframes: Rows, fit: Fit, sharing: Sharing, index: int) -> Array:
    """Correlations (N, N; below the diagonal) of predictions' errors."""
    count, looks = len(keyframes), np.empty((len(keyframes), 3))
    for i in range(count):
        x, y, z = keyframes[i].forward[0], keyframes[i].forward[1], keyframes[i].forward[2]
        c, s = cos(keyframes[i].state[3]), sin(keyframes[i].state[3])
        looks[i, 0], looks[i, 1], looks[i, 2] = c * x + s * z, y, c * z - s * x
    factor = (fit.covariance[3, 3] + fit.covariance[4, 4] + fit.covariance[5, 5]) / 3
    length = sharing.sizes * sqrt(factor * expected_variances(keyframes[index].whitening)[0])
    alike = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            apart = turned = 0.0
            for k in range(3):
                apart += (keyframes[i].state[k] - keyframes[j].state[k]) ** 2
                turned += (looks[i, k] - looks[j, k]) ** 2  # the angle's square, for small ones
            faded = sqrt(apart) / length + turned / (2 * sharing.turn**2)
            if faded < -log(_ALIKE):
                alike[i, j] = sharing.share * exp(-faded)
    return alike


@compiled
def _write_together(moved: Array, alike: Array, i: int, together: Array) -> None:
    """Writes what one keyframe's error moves, (6, 4), with what those before it move that are alike (N,). These count
    twice, as each pair is met once."""
    for k in range(6):
        for m in range(4):
            together[k, m] = moved[i, k, m]
    for j in range(i):
        if alike[j] > _ALIKE:
            for k in range(6):
                for m in range(4):
                    together[k, m] += 2 * alike[j] * moved[j, k, m]


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
