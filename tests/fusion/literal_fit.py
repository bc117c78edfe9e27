"""The fit of `drift_aware` as it is defined, slow and literal: scipy's least squares over all predictions, in turns
with what each counts and how their errors go together. It shares no code with fusion/."""

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array

if TYPE_CHECKING:
    from groundwalk.fusion.methods.drift_aware_options import DriftAwareOptions


def literal_fit(vio: Array, apr: Array, drift: Array, o: "DriftAwareOptions", turns: int = 40) -> Array:
    """The last poses' alignment: (N, 4) map position and yaw at each frame.

    vio, apr: poses (N, 4, 4). drift: variances (N, 4) of x, y, z, yaw on the way to each frame. o: options.
    """
    count = len(vio)
    sizes = np.repeat([np.radians(o.rotation_sd_deg), o.position_sd_m], 3)
    shape = np.eye(6)
    shape[1, 3] = shape[3, 1] = -o.side_turn
    shape[0, 4] = shape[4, 0] = o.side_turn
    share = _shares(vio, o)
    start = [_heading(apr[i, :3, :3] @ vio[i, :3, :3].T) for i in range(count)]
    x = np.column_stack([apr[:, :3, 3], np.full(count, start[0])])
    x[:, :3] = apr[0, :3, 3] + (vio[:, :3, 3] - vio[0, :3, 3]) @ _yaw(start[0]).T
    covariance, tilt, posterior = shape.copy(), np.zeros(2), np.zeros((count, 4, 4))
    for _ in range(turns):
        each = _independent(x, vio, drift, sizes[3] ** 2 * np.trace(covariance[3:, 3:]) / 3, o)
        slopes = [_slope(x[i], vio[i], sizes) for i in range(count)]
        spread = [e * s @ p @ s.T for e, s, p in zip(each, slopes, posterior, strict=True)]
        errors = np.array([_error(x[i], vio[i], apr[i], tilt) / sizes for i in range(count)])
        weights = [_weight(e, v, covariance, o.degrees_of_freedom) for e, v in zip(errors, spread, strict=True)]
        parts = zip(share, weights, errors, spread, strict=True)
        scatter = sum(s * w * (np.outer(e, e) + v) for s, w, e, v in parts)
        scatter = (scatter + o.size_count * shape) / (o.size_count + share.sum())
        variances = np.diag(scatter)
        means = np.repeat(variances.reshape(2, 3).mean(axis=1), 3)
        believed = o.axis_count / (o.axis_count + o.size_count + share.sum())
        sd = np.sqrt((1 - believed) * variances + believed * means)
        scatter = scatter * np.outer(sd, sd) / np.sqrt(np.outer(variances, variances))
        believed = o.side_turn_count / (o.side_turn_count + share.sum())
        covariance = (1 - believed) * scatter + believed * np.outer(sd, sd) * shape + 1e-6 * np.eye(6)
        roots = [_roots(e, v, covariance, o) for e, v in zip(errors, spread, strict=True)]
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))

        def residuals(
            flat: Array, tilt: Array = tilt, roots: list[Array] = roots, whiten: Array = whiten, each: Array = each
        ) -> Array:
            y = flat.reshape(-1, 4)
            found = [
                np.sqrt(each[i] * share[i]) * (whiten @ (roots[i] * _error(y[i], vio[i], apr[i], tilt) / sizes))
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

        def leaning(
            tilt: Array, x: Array = x, roots: list[Array] = roots, whiten: Array = whiten, each: Array = each
        ) -> Array:
            found = [
                np.sqrt(0.1 * each[i] * share[i]) * (whiten @ (roots[i] * _error(x[i], vio[i], apr[i], tilt) / sizes))
                for i in range(count)
            ]
            return np.concatenate([*found, tilt / np.radians(o.tilt_sd_deg)])

        tilt = least_squares(leaning, tilt, x_scale=1e-3).x
    return x


def _error(x: Array, vio: Array, apr: Array, tilt: Array) -> Array:
    """Rotation (rad) before position error of a prediction in camera axes, when the camera is at x, y, z, yaw."""
    turn = _yaw(_heading(apr[:3, :3] @ vio[:3, :3].T))
    lean = Rotation.from_matrix(apr[:3, :3] @ vio[:3, :3].T @ turn.T).as_rotvec()
    off = (_heading(turn) - x[3] + np.pi) % (2 * np.pi) - np.pi
    camera = (_yaw(x[3]) @ vio[:3, :3]).T
    rotation = camera @ [lean[0], off, lean[2]] - vio[:3, :3].T @ [tilt[0], 0.0, tilt[1]]
    return np.concatenate([rotation, camera @ (apr[:3, 3] - x[:3])])


def _slope(x: Array, vio: Array, sizes: Array) -> Array:
    """How a prediction's normalised error (6,) changes with x, y, z and yaw."""
    camera = (_yaw(x[3]) @ vio[:3, :3]).T
    slope = np.zeros((6, 4))
    slope[3:, :3], slope[:3, 3] = -camera, -camera[:, 1]
    return slope / sizes[:, None]


def _weight(error: Array, spread: Array, covariance: Array, dof: float) -> float:
    precision = np.linalg.inv(covariance)
    return (dof + len(error)) / (dof + error @ precision @ error + np.trace(precision @ spread))


def _roots(error: Array, spread: Array, covariance: Array, o: "DriftAwareOptions") -> Array:
    """Roots (6,) of what a prediction's rotation and position count, by the whole error and by their own."""
    unknown = np.trace(spread[3:, 3:]) / np.trace(covariance[3:, 3:])
    more = (o.position_degrees_of_freedom - o.degrees_of_freedom) / (1 + 10 * unknown)
    position_dof = o.degrees_of_freedom + more
    parts = []
    for numbers, marginal, dof in (
        (slice(3), o.rotation_marginal, o.degrees_of_freedom),
        (slice(3, 6), o.position_marginal, position_dof),
    ):
        whole = _weight(error, spread, covariance, dof)
        own = _weight(error[numbers], spread[numbers, numbers], covariance[numbers, numbers], dof)
        parts.append((whole ** (1 - marginal) * own**marginal) ** (dof / 4))
    return np.repeat(parts, 3)


def _independent(x: Array, vio: Array, drift: Array, variance: float, o: "DriftAwareOptions") -> Array:
    """What each prediction counts: those alike by place and view are one, as far as odometry lets one average them."""
    looks = np.array([_yaw(state[3]) @ pose[:3, 2] for state, pose in zip(x, vio, strict=True)])
    apart = np.linalg.norm(x[:, None, :3] - x[None, :, :3], axis=2) / np.sqrt(variance)
    turned = np.linalg.norm(looks[:, None] - looks[None], axis=2) / np.radians(o.shared_turn_deg)
    faded = apart / o.shared_sizes + turned**2 / 2
    alike = np.where(faded < np.log(1000), o.shared * np.exp(-faded), 0.0)
    drifted = np.abs(np.subtract.outer(np.cumsum(drift[:, 0]), np.cumsum(drift[:, 0])))
    both = alike / (1 + drifted / variance)
    np.fill_diagonal(both, 1.0)
    return np.asarray(1 / both.sum(axis=1))


def _shares(vio: Array, o: "DriftAwareOptions") -> Array:
    found = [1.0]
    for a, b in pairwise(vio):
        gap = np.linalg.norm(b[:3, 3] - a[:3, 3])
        gap += o.turn_length_m * np.linalg.norm(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec())
        found.append(float(gap / (gap + o.apart_m)))
    return np.array(found)


def _yaw(angle: float) -> Array:
    return Rotation.from_rotvec([0, angle, 0]).as_matrix()


def _heading(rotation: Array) -> float:
    return np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
