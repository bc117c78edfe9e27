"""How the errors of predictions are correlated.

Predictions of one place share a part of their error, wherever on the walk they were made, as long as the camera looks
the same way. How far that reaches grows with the errors' size: those of PoseNet, MS-Transformer and DFNet fade within
half a metre on 7-Scenes and within some metres on KingsCollege, and with a turn of 30 to 45 degrees in either."""

from math import cos, exp, log, radians, sin, sqrt

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.keyframes import Rows
from groundwalk.fusion.methods.estimator.odometry_quality import expected_variances
from groundwalk.geometry.poses import Array

_SHARE = 0.9  # of their errors' variance that predictions of one place have in common, ...
_REACH = 10.0  # ... which fades to 1/e over so many standard deviations of a prediction's position an axis, ...
_TURN = radians(45.0)  # ... and to 1/sqrt(e) with such a turn of the camera (the ranges above, generously)
_LEAST = 1e-3  # correlation below which errors are independent


@compiled
def position_variances(keyframes: Rows, covariance: Array) -> Array:
    """Of each prediction's position error an axis, (N,). covariance (6, 6): of normalised errors."""
    factor = (covariance[3, 3] + covariance[4, 4] + covariance[5, 5]) / 3
    variances = np.empty(len(keyframes))
    for i in range(len(keyframes)):
        variances[i] = factor * expected_variances(keyframes[i].whitening)[0]
    return variances


@compiled
def error_correlations(keyframes: Rows, variances: Array) -> Array:
    """Correlations (N, N; below the diagonal) of the errors of predictions, whose positions have these variances."""
    count = len(keyframes)
    looks, correlation = np.empty((count, 3)), np.zeros((count, count))
    for i in range(count):
        x, y, z = keyframes[i].forward[0], keyframes[i].forward[1], keyframes[i].forward[2]
        c, s = cos(keyframes[i].state[3]), sin(keyframes[i].state[3])
        looks[i, 0], looks[i, 1], looks[i, 2] = c * x + s * z, y, c * z - s * x
        for j in range(i):
            apart = turned = 0.0
            for k in range(3):
                apart += (keyframes[i].state[k] - keyframes[j].state[k]) ** 2
                turned += (looks[i, k] - looks[j, k]) ** 2  # the angle's square, for small ones
            apart /= (variances[i] + variances[j]) / 2
            faded = sqrt(apart) / _REACH + turned / (2 * _TURN**2)
            if faded < -log(_LEAST):
                correlation[i, j] = _SHARE * exp(-faded)
    return correlation


@compiled
def effective_weights(keyframes: Rows, variances: Array, correlation: Array, drift_factor: float) -> Array:
    """What each prediction counts of an independent one, (N,): those that are wrong alike count as one, as far as
    odometry lets one average over both. drift_factor: of the usual variance of drift."""
    count = len(keyframes)
    since, others = np.zeros(count), np.ones(count)
    for i in range(count):
        if i > 0:
            since[i] = since[i - 1] + drift_factor * keyframes[i].drift[0] + keyframes[i].added_variance[0]
        for j in range(i):
            if correlation[i, j] > 0:
                variance = (variances[i] + variances[j]) / 2
                both = correlation[i, j] * variance / (variance + since[i] - since[j])
                others[i] += both
                others[j] += both
    return 1 / others
