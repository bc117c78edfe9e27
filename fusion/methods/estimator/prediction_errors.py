"""How wrong a regressor's predictions are: their errors' covariance in camera axes, learnt from the walk itself.

A step to the side and a turn move an image nearly alike, and a step up and a nod: a regressor takes one for the
other. In camera axes its errors in x come with errors about y of the other sign, and errors in y with errors about x.
Odometry knows gravity, so the error about the horizontal axes is known of each prediction whatever the alignment is,
and once the yaw is known well, so is the rest: knowing how the errors go together, most of a position error can be
told from the rotation's.

Errors are six numbers, rotation (rad) before position (m), in camera axes. Each prediction's is divided by the size
that was expected of it beforehand. What is left has one covariance, learnt as a t distribution's scatter matrix by
expectation and maximisation.

Predictions of one place share a part of their error, wherever on the walk they were made, as long as the camera looks
the same way. How far that reaches grows with the errors' size: those of PoseNet, MS-Transformer and DFNet fade within
half a metre on 7-Scenes and within some metres on KingsCollege, and with a turn of 30 to 45 degrees in either."""

from math import cos, exp, log, radians, sin, sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import Rows, compiled
from groundwalk.geometry.poses import Array

# A relative floor that keeps the learnt covariance regular: nobody's errors are a thousandth of what was expected.
_MIN_VARIANCE = 1e-6
# Shrinkage is a half where a prediction's position variance is so many times odometry's drift since the last one.
_DRIFTS = 10.0
_SHARE = 0.9  # of their errors' variance that predictions of one place have in common, ...
_REACH = 10.0  # ... which fades to 1/e over so many standard deviations of a prediction's position an axis, ...
_TURN = radians(45.0)  # ... and to 1/sqrt(e) with such a turn of the camera (the ranges above, generously)
_LEAST = 1e-3  # correlation below which errors are independent


class Prior(NamedTuple):
    """What is expected of the covariance without the fit: `shape` (6, 6) is a correlation matrix, which counts as
    `shape_count` predictions, and the `sizes` (6,) of normalised errors count as `size_count`. That rotation errors are
    as large about each axis, and position errors along each, counts as `axis_count`."""

    shape: Array
    shape_count: float
    size_count: float
    axis_count: float
    sizes: Array = np.ones(6)


def side_turn_correlation(correlation: float) -> Array:
    """The correlation matrix (6, 6) of errors in camera axes (x right, y down, z forward), rotation before position, in
    which a step aside is taken for a turn and a step up for a nod, to the given extent."""
    shape = np.eye(6)
    shape[1, 3] = shape[3, 1] = -correlation
    shape[0, 4] = shape[4, 0] = correlation
    return shape


def whitening(camera_covariance: Array, vio_R_cam: Array) -> Array:
    """B (6, 6), which normalises an error in odometry's axes whose covariance (6, 6) is expected in camera axes."""
    return np.linalg.solve(np.linalg.cholesky(camera_covariance), np.kron(np.eye(2), vio_R_cam.T))


@compiled
def expected_variances(whitening: Array) -> tuple[float, float]:
    """Of a prediction's position an axis and of its yaw, from what normalises its error (6, 6)."""
    position = yaw = 0.0
    for k in range(6):
        yaw += whitening[1, k] ** 2
        for j in range(3, 6):
            position += whitening[j, k] ** 2
    return 3 / position, 1 / yaw


def shrinkage_of(covariance: Array, drift: Array) -> float:
    """How far to shrink a prediction's covariance (6, 6), 0 to 1 (`shrunk`); drift (3,): variances (m^2) of odometry's
    drift since the last prediction.

    The direction of position errors and their correlation with rotation errors are geometry where the prediction is
    much better than odometry. A regressor's predictions are a lot worse and averaged over many, and its covariances say
    little of the errors that those share.
    """
    variance = float(covariance.diagonal()[3:].mean())
    return variance / (_DRIFTS * float(drift.mean()) + variance)


def shrunk(covariance: Array, shrinkage: float) -> Array:
    """A covariance (6, 6) shrunk towards one with the same rotation part and size of position errors, which have no
    direction and no correlation with rotation errors."""
    result: Array = covariance.copy()
    result[3:] *= 1 - shrinkage
    result[:3, 3:] *= 1 - shrinkage
    result[3:, 3:] += shrinkage * covariance.diagonal()[3:].mean() * np.eye(3)
    return result


@compiled
def scatter(prior: Prior, errors: Array, spread: Array, weights: Array) -> Array:
    """The covariance (6, 6) of normalised errors (N, 6), of which covariances `spread` (N, 6, 6) aren't known.
    weights (N,): what Student's t lets each count."""
    covariance, count = np.zeros((6, 6)), len(errors)
    for i in range(count):
        for j in range(6):
            for k in range(6):
                covariance[j, k] += weights[i] * (errors[i, j] * errors[i, k] + spread[i, j, k])
    believed = prior.shape_count / (prior.shape_count + count)
    for j in range(6):
        for k in range(6):
            covariance[j, k] += prior.size_count * prior.sizes[j] * prior.sizes[k] * prior.shape[j, k]
            covariance[j, k] /= prior.size_count + count
    sd, ratio = np.empty(6), np.empty(6)
    for j in range(6):
        mean, first = 0.0, 3 * (j // 3)
        for k in range(first, first + 3):
            mean += covariance[k, k] / 3
        total = prior.size_count + count
        sd[j] = sqrt((total * covariance[j, j] + prior.axis_count * mean) / (total + prior.axis_count))
        ratio[j] = sd[j] / sqrt(covariance[j, j])
    for j in range(6):
        for k in range(6):
            covariance[j, k] *= (1 - believed) * ratio[j] * ratio[k]
            covariance[j, k] += believed * sd[j] * sd[k] * prior.shape[j, k]
        covariance[j, j] += _MIN_VARIANCE
    return covariance


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
