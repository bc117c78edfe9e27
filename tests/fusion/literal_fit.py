"""The fit of `drift_aware` as it is defined, slow and literal: scipy's least squares over all predictions, in turns
with what each counts and how their errors go together. It shares no code with fusion/."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array

_DOF, _SIZE_COUNT, _AXIS_COUNT, _SIDE_TURN, _SIDE_TURN_COUNT = 3.0, 0.3, 10.0, 0.7, 20.0
_SHARED, _SHARED_SIZES, _SHARED_TURN = 0.9, 10.0, np.radians(45.0)


def literal_fit(vio: Array, apr: Array, drift: Array, sizes: Array, tilt_sd: float, turns: int = 20) -> Array:
    """The last poses' alignment: (N, 4) map position and yaw at each frame.

    vio, apr: poses (N, 4, 4). drift: variances (N, 4) of x, y, z, yaw on the way to each frame. sizes (6,): assumed
    errors of a prediction. tilt_sd: of odometry's vertical, an axis.
    """
    count = len(vio)
    shape = np.eye(6)
    shape[1, 3] = shape[3, 1] = -_SIDE_TURN
    shape[0, 4] = shape[4, 0] = _SIDE_TURN
    start = [_heading(apr[i, :3, :3] @ vio[i, :3, :3].T) for i in range(count)]
    x = np.column_stack([apr[:, :3, 3], np.full(count, start[0])])
    x[:, :3] = apr[0, :3, 3] + (vio[:, :3, 3] - vio[0, :3, 3]) @ _yaw(start[0]).T
    size_count = _SIZE_COUNT / (1 + count)  # sizes that were assumed first are forgotten
    covariance, posterior, lean = shape.copy(), np.zeros((count, 4, 4)), np.zeros(3)
    for _ in range(turns):
        each = _independent(x, vio, drift, sizes[3] ** 2 * np.trace(covariance[3:, 3:]) / 3)
        slopes = [_slope(x[i], vio[i], sizes) for i in range(count)]
        spread = [e * s @ p @ s.T for e, s, p in zip(each, slopes, posterior, strict=True)]
        errors = np.array([_error(x[i], vio[i], apr[i], lean) / sizes for i in range(count)])
        weights = [_weight(e, v, covariance) for e, v in zip(errors, spread, strict=True)]
        parts = zip(weights, errors, spread, strict=True)
        scatter = sum(w * (np.outer(e, e) + v) for w, e, v in parts)
        scatter = (scatter + size_count * shape) / (size_count + count)
        variances = np.diag(scatter)
        means = np.repeat(variances.reshape(2, 3).mean(axis=1), 3)
        believed = _AXIS_COUNT / (_AXIS_COUNT + size_count + count)
        sd = np.sqrt((1 - believed) * variances + believed * means)
        scatter = scatter * np.outer(sd, sd) / np.sqrt(np.outer(variances, variances))
        believed = _SIDE_TURN_COUNT / (_SIDE_TURN_COUNT + count)
        covariance = (1 - believed) * scatter + believed * np.outer(sd, sd) * shape + 1e-6 * np.eye(6)
        # Barron's kernel of shape 2 - dof, under which the usual error counts 1.
        roots = [_weight(e, v, covariance) ** (_DOF / 4) for e, v in zip(errors, spread, strict=True)]
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))

        def residuals(
            flat: Array, roots: list[float] = roots, whiten: Array = whiten, each: Array = each, lean: Array = lean
        ) -> Array:
            y = flat.reshape(-1, 4)
            found = [
                np.sqrt(each[i]) * roots[i] * (whiten @ (_error(y[i], vio[i], apr[i], lean) / sizes))
                for i in range(count)
            ]
            for i in range(1, count):
                step = _yaw(y[i - 1, 3]) @ (vio[i, :3, 3] - vio[i - 1, :3, 3])
                left = np.append(y[i, :3] - y[i - 1, :3] - step, y[i, 3] - y[i - 1, 3])
                found.append(left / np.sqrt(drift[i]))
            return np.concatenate(found)

        best = least_squares(residuals, x.ravel(), x_scale="jac")
        x = best.x.reshape(-1, 4)
        inverse = np.linalg.inv(best.jac.T @ best.jac).reshape(count, 4, count, 4)
        posterior = np.array([inverse[i, :, i] for i in range(count)])
        # Predictions name odometry's lean, which their mean tells little better than one of them.
        counts = np.array([e * r**2 for e, r in zip(each, roots, strict=True)])
        variance = np.trace(covariance[:3, :3]) / 3 * sizes[0] ** 2
        tilts = np.array([_tilt(x[i], vio[i], apr[i]) for i in range(count)])
        unsure = variance / counts.sum() + variance
        lean = tilt_sd**2 / (tilt_sd**2 + unsure) * (counts @ tilts) / counts.sum()
    return x


def _error(x: Array, vio: Array, apr: Array, lean: Array) -> Array:
    """Rotation (rad) before position error of a prediction in camera axes, when the camera is at x, y, z, yaw and
    odometry's vertical leans, about its axes (3,)."""
    heading = _heading(apr[:3, :3] @ vio[:3, :3].T)
    off = (heading - x[3] + np.pi) % (2 * np.pi) - np.pi
    rotation = vio[:3, :3].T @ (_tilt(x, vio, apr) - lean + [0, off, 0])
    return np.concatenate([rotation, (_yaw(x[3]) @ vio[:3, :3]).T @ (apr[:3, 3] - x[:3])])


def _tilt(x: Array, vio: Array, apr: Array) -> Array:
    """What a prediction leans against odometry's vertical, about odometry's axes (3,)."""
    turn = _yaw(_heading(apr[:3, :3] @ vio[:3, :3].T))
    lean = Rotation.from_matrix(apr[:3, :3] @ vio[:3, :3].T @ turn.T).as_rotvec()
    return _yaw(x[3]).T @ [lean[0], 0, lean[2]]


def _slope(x: Array, vio: Array, sizes: Array) -> Array:
    """How a prediction's normalised error (6,) changes with x, y, z and yaw."""
    camera = (_yaw(x[3]) @ vio[:3, :3]).T
    slope = np.zeros((6, 4))
    slope[3:, :3], slope[:3, 3] = -camera, -camera[:, 1]
    return slope / sizes[:, None]


def _weight(error: Array, spread: Array, covariance: Array) -> float:
    precision = np.linalg.inv(covariance)
    return (_DOF + len(error)) / (_DOF + error @ precision @ error + np.trace(precision @ spread))


def _independent(x: Array, vio: Array, drift: Array, variance: float) -> Array:
    """What each prediction counts: those alike by place and view are one, as far as odometry lets one average them."""
    looks = np.array([_yaw(state[3]) @ pose[:3, 2] for state, pose in zip(x, vio, strict=True)])
    apart = np.linalg.norm(x[:, None, :3] - x[None, :, :3], axis=2) / np.sqrt(variance)
    turned = np.linalg.norm(looks[:, None] - looks[None], axis=2) / _SHARED_TURN
    faded = apart / _SHARED_SIZES + turned**2 / 2
    alike = np.where(faded < np.log(1000), _SHARED * np.exp(-faded), 0.0)
    drifted = np.abs(np.subtract.outer(np.cumsum(drift[:, 0]), np.cumsum(drift[:, 0])))
    both = alike / (1 + drifted / variance)
    np.fill_diagonal(both, 1.0)
    return np.asarray(1 / both.sum(axis=1))


def _yaw(angle: float) -> Array:
    return Rotation.from_rotvec([0, angle, 0]).as_matrix()


def _heading(rotation: Array) -> float:
    return np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
