"""Surveyed points against the same points in a map: how far each is off by a fit of the other half of them, so that no
point judges itself, and how far it is expected to be."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.fits import Sim3, fit_similarity
from groundwalk.geometry.poses import Array, skew

Mask = NDArray[np.bool_]

# Each half needs so many points for a fit.
MIN_FIT = 3


@dataclass(frozen=True)
class ControlFit:
    """`survey_S_map` by all points that take part (scale 1 where it is rigid), the covariance (7, 7) of its rotation,
    translation at their middle, and log scale; and each point's residual (K, 3), survey minus map, by the fit of the
    other half (`held_out`), with its covariance (K, 3, 3); in the survey's axes, NaN where there is none."""

    survey_S_map: Sim3
    covariance: Array
    held_out: Array
    held_out_covariance: Array


def fit_control(
    survey: Array, sd_m: Array, xyz: Array, covariance: Array, used: Mask, *, rigid: bool, scale_sd: float = 0.0
) -> ControlFit:
    """Fit points (K, 3) of a map with covariances (K, 3, 3) to surveyed ones (K, 3) with standard errors (K,).

    `used` (K,) take part. `scale_sd`: standard error of the map's scale, which a rigid fit leaves in the residuals.
    Raises GeometryError where they are too few or on a line.
    """
    whole, parameters = _fit(survey, sd_m, xyz, covariance, used, rigid=rigid)
    held_out, held_out_covariance = np.full(survey.shape, np.nan), np.full((len(survey), 3, 3), np.nan)
    order = np.flatnonzero(used)
    for judged in (order[::2], order[1::2]) if len(order) >= 2 * MIN_FIT else ():
        others = used.copy()
        others[judged] = False
        fit, of_fit = _fit(survey, sd_m, xyz, covariance, others, rigid=rigid)
        jacobian, arm = similarity_jacobian(fit, xyz[judged], xyz[others].mean(axis=0))
        held_out[judged] = survey[judged] - fit.points(xyz[judged])
        held_out_covariance[judged] = (
            jacobian @ of_fit @ np.swapaxes(jacobian, 1, 2)
            + _point_covariance(fit, sd_m[judged], covariance[judged])
            + (scale_sd if rigid else 0.0) ** 2 * arm[:, :, None] * arm[:, None, :]
        )
    return ControlFit(whole, parameters, held_out, held_out_covariance)


def _fit(survey: Array, sd_m: Array, xyz: Array, covariance: Array, used: Mask, *, rigid: bool) -> tuple[Sim3, Array]:
    """The least squares weighted by the points' variances, and its covariance (7, 7), which the residuals' scatter
    widens."""
    unit = 1.0 if rigid else fit_similarity(survey[used], xyz[used], np.ones(used.sum()), rigid=False).scale
    variance = sd_m[used] ** 2 + unit**2 * np.trace(covariance[used], axis1=1, axis2=2) / 3
    weights = 1 / variance
    fit = fit_similarity(survey[used], xyz[used], weights, rigid=rigid)
    jacobian, _ = similarity_jacobian(fit, xyz[used], xyz[used].mean(axis=0))
    free = slice(0, 6 if rigid else 7)
    weighted = weights[:, None, None] * np.swapaxes(jacobian[:, :, free], 1, 2)
    inverse = np.linalg.inv((weighted @ jacobian[:, :, free]).sum(axis=0))
    spread = weighted @ _point_covariance(fit, sd_m[used], covariance[used]) @ np.swapaxes(weighted, 1, 2)
    squares = np.sum(weights[:, None] * (survey[used] - fit.points(xyz[used])) ** 2)
    excess = max(1.0, float(squares) / max(3 * int(used.sum()) - len(inverse), 1))
    result = np.zeros((7, 7))
    result[free, free] = excess * inverse @ spread.sum(axis=0) @ inverse
    return fit, result


def similarity_jacobian(fit: Sim3, xyz: Array, middle: Array) -> tuple[Array, Array]:
    """Derivatives (N, 3, 7) of fitted points by a turn and shift about `middle` (3,) and the log scale, and how far
    (N, 3) the points are from it."""
    arm = fit.scale * (xyz - middle) @ fit.rotation.T
    identity = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    return np.concatenate([-skew(arm), identity, arm[:, :, None]], axis=2), arm


def _point_covariance(fit: Sim3, sd_m: Array, covariance: Array) -> Array:
    turned = fit.scale**2 * fit.rotation @ covariance @ fit.rotation.T
    return np.asarray(turned + sd_m[:, None, None] ** 2 * np.eye(3))
