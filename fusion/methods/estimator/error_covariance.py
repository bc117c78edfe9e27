"""How wrong a regressor's predictions are: their errors' covariance in camera axes, learnt from the walk itself.

A step to the side and a turn move an image nearly alike, and a step up and a nod: a regressor takes one for the
other. In camera axes its errors in x come with errors about y of the other sign, and errors in y with errors about x.
Odometry knows gravity, so the error about the horizontal axes is known of each prediction whatever the alignment is,
and once the yaw is known well, so is the rest: knowing how the errors go together, most of a position error can be
told from the rotation's.

Errors are six numbers, rotation (rad) before position (m), in camera axes. Each prediction's is divided by the size
that was expected of it beforehand. What is left has one covariance, learnt as a t distribution's scatter matrix by
expectation and maximisation."""

from math import sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.error_map import Expected
from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.geometry.poses import Array

# A relative floor that keeps the learnt covariance regular: nobody's errors are a thousandth of what was expected.
_MIN_VARIANCE = 1e-6
# Shrinkage is a half where a prediction's position variance is so many times odometry's drift since the last one.
_DRIFTS = 10.0


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


@compiled
def whitening(size: Array, vio_R_cam: Array) -> Array:
    """B (6, 6), which normalises an error in odometry's axes: to camera axes, over the sizes (6,)."""
    matrix = np.zeros((6, 6))
    for j in range(3):
        for k in range(3):
            matrix[j, k] = vio_R_cam[k, j] / size[j]
            matrix[3 + j, 3 + k] = vio_R_cam[k, j] / size[3 + j]
    return matrix


def sizes_expected(expected: Expected) -> Array:
    """Sizes (6,) of errors in camera axes from what held-out frames tell of a place."""
    yaw, x, y, z = (
        shared + noise for shared, noise in zip(expected.shared.tolist(), expected.noise.tolist(), strict=True)
    )
    yaw += expected.yaw_per_m[0] ** 2 * x + expected.yaw_per_m[1] ** 2 * z
    rotation, position = sqrt((yaw + 2 * expected.tilt) / 3), sqrt((x + y + z) / 3)
    return np.array([rotation, rotation, rotation, position, position, position])


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


def whitening_of_covariance(covariance: Array, map_R_cam: Array, vio_R_cam: Array) -> Array:
    """B (6, 6) from the covariance (6, 6) that a prediction brings: map axes, rotation (rad) before position."""
    turn = np.kron(np.eye(2), map_R_cam)
    factor = np.linalg.cholesky(turn.T @ covariance @ turn)
    back = np.kron(np.eye(2), vio_R_cam.T)
    return np.linalg.solve(factor, back)


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
