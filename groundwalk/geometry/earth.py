"""Where on earth a map lies: a fit of its points to positions by GPS, whose errors last for minutes."""

from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.control import similarity_jacobian
from groundwalk.geometry.fits import Sim3, fit_robust, fit_similarity
from groundwalk.geometry.poses import Array, yaw_rotation
from groundwalk.geometry.rows import evenly

Origin = tuple[float, float, float]
"""Latitude, longitude (degrees) and altitude (metres) of the origin of east, north, up in WGS84."""

MIN_FIXES = 3
ENU_R_YUP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From a map with +y up to one with +z up."""
# Errors of a phone's GPS are alike for so long: those of two fixes apart by it correlate by 1/e.
_CORRELATION_S = 120.0
_MAX_FIXES = 1000  # their correlations are a matrix
_FLOOR = 4.0  # sigmas below which residuals count alike
_ITERATIONS = 3  # from a start that is nearly right


def enu_of(origin: Origin, geodetic: Array) -> Array:
    """East, north, up (N, 3), metres, of latitudes, longitudes and altitudes (N, 3); up is NaN without an altitude."""
    altitude = np.where(np.isnan(geodetic[:, 2]), origin[2], geodetic[:, 2])
    enu = np.stack(pymap3d.geodetic2enu(geodetic[:, 0], geodetic[:, 1], altitude, *origin), axis=1)
    enu[np.isnan(geodetic[:, 2]), 2] = np.nan
    return np.asarray(enu)


def geodetic_of(origin: Origin, enu: Array) -> Array:
    """Latitude, longitude (degrees) and altitude (metres) (N, 3) of east, north, up (N, 3)."""
    return np.stack(pymap3d.enu2geodetic(*enu.T, *origin), axis=1)


def geodetic_of_utm(xy: Array, zone: int, *, south: bool) -> Array:
    """Latitudes and longitudes (N, 2), degrees, in WGS84 of eastings and northings (N, 2) in a zone of UTM: Krüger's
    series to the third order, to about a millimetre within the zone."""
    f = 1 / 298.257223563
    n = f / (2 - f)
    radius = 0.9996 * 6378137.0 / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    at = ((xy[:, 1] - (1e7 if south else 0.0)) + 1j * (xy[:, 0] - 5e5)) / radius
    of_sphere = [n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480]
    at = at - sum(c * np.sin(2 * j * at) for j, c in enumerate(of_sphere, 1))
    conformal = np.arcsin(np.sin(at.real) / np.cosh(at.imag))
    of_latitude = [2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15]
    latitude = conformal + sum(c * np.sin(2 * j * conformal) for j, c in enumerate(of_latitude, 1))
    longitude = np.radians(6 * zone - 183) + np.arctan2(np.sinh(at.imag), np.cos(at.real))
    return np.degrees(np.column_stack([latitude, longitude]))


@dataclass(frozen=True)
class EarthFit:
    """`enu_S_map`; the covariance (7, 7) of its rotation about east, north, up, its translation at `middle` (3,) of the
    map, and its log scale, NaN for an up that nothing tells; residuals (N, 3), fix minus map; and `free_scale`, the
    metres per unit that the fixes themselves would give."""

    enu_S_map: Sim3
    covariance: Array
    middle: Array
    residual: Array
    free_scale: float


def fit_earth(
    enu: Array, sd: Array, xyz: Array, t_s: Array, walk: NDArray[np.int64], *, rigid: bool, vertical_sd: float | None
) -> EarthFit:
    """Fit points (N, 3) of a map to fixes (N, 3), up NaN where it isn't known, with standard errors (N, 3) an axis.

    `t_s` (N,) and `walk` (N,) say which fixes' errors are alike. With `vertical_sd`, radians, the map's +y is up to so
    much, and only its heading is free; None: all of its rotation is, and fixes without altitude say nothing. A map
    with a scale is moved `rigid`ly. Outliers hardly count. GeometryError where fixes are too few, or of one place.
    """
    upright, is_known = vertical_sd is not None, np.isfinite(enu)
    usable = np.flatnonzero(is_known[:, : 2 if upright else 3].all(axis=1))
    if len(usable) < MIN_FIXES:
        raise GeometryError(f"{len(usable)} fixes, {MIN_FIXES} are needed")
    rows = usable[evenly(len(usable), _MAX_FIXES)]
    has_up = bool(is_known[rows, 2].any())
    free = [*([2] if upright else [0, 1, 2]), 3, 4, *([5] if has_up else []), *([] if rigid else [6])]
    known, a, b = is_known[rows], np.nan_to_num(enu[rows]), xyz[rows]
    inverse_sd = np.where(known, 1 / np.where(known, sd[rows], 1), 0)

    def start(weights: Array, *, rigid: bool) -> Sim3:
        weights = weights * inverse_sd[:, 0] ** 2
        return (_upright_fit if upright else fit_similarity)(a, b, weights, rigid=rigid)

    def fit(weights: Array) -> Sim3:
        found, middle = start(weights, rigid=rigid), np.average(b, axis=0, weights=weights)
        for _ in range(_ITERATIONS):
            scaled_by = inverse_sd * np.sqrt(weights)[:, None]
            jacobian = similarity_jacobian(found, b, middle)[0][:, :, free] * scaled_by[..., None]
            residual, step = (a - found.points(b)) * scaled_by, np.zeros(7)
            step[free] = np.linalg.lstsq(jacobian.reshape(-1, len(free)), residual.ravel(), rcond=1e-9)[0]
            turn, factor = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
            at = found.points(middle)
            translation = factor * turn @ (found.translation - at) + at + step[3:6]
            found = Sim3(factor * found.scale, turn @ found.rotation, translation)
        return found

    def in_sigmas(found: Sim3) -> Array:
        return np.asarray(np.linalg.norm((a - found.points(b)) * inverse_sd, axis=1))

    found, robust = fit_robust(fit, in_sigmas, len(rows), floor=_FLOOR)
    middle = np.average(b, axis=0, weights=robust)
    apart_s = np.abs(t_s[rows, None] - t_s[rows])
    correlation = np.exp(-apart_s / _CORRELATION_S) * (walk[rows, None] == walk[rows])
    covariance = np.zeros((7, 7))
    jacobian = similarity_jacobian(found, b, middle)[0][:, :, free] * inverse_sd[..., None]
    weighted = robust[:, None, None] * jacobian
    try:
        inverse = np.linalg.inv(np.einsum("nai,naj->ij", weighted, jacobian))
    except np.linalg.LinAlgError:
        raise GeometryError("the fixes, or the map's points, are in one place or on a line") from None
    spread = np.einsum("nai,nm,maj->ij", weighted, correlation, weighted, optimize=True)
    excess = max(1.0, float(robust @ in_sigmas(found) ** 2 / (robust @ known.sum(axis=1))))
    covariance[np.ix_(free, free)] = excess * inverse @ spread @ inverse
    if vertical_sd is not None:
        covariance[[0, 1], [0, 1]] = vertical_sd**2
    if not has_up:
        covariance[5, 5] = np.nan
    return EarthFit(found, covariance, middle, enu - found.points(xyz), start(robust, rigid=False).scale)


def _upright_fit(enu: Array, xyz: Array, weights: Array, *, rigid: bool) -> Sim3:
    """The heading, scale and horizontal translation with the least squares, as a complex number each; up is that of the
    map."""
    w = weights / weights.sum()
    at, of_map = enu[:, 0] + 1j * enu[:, 1], xyz[:, 0] - 1j * xyz[:, 2]
    mean, mean_of_map = w @ at, w @ of_map
    across = complex(w @ (np.conj(of_map - mean_of_map) * (at - mean)))
    spread = float(w @ np.abs(of_map - mean_of_map) ** 2)
    if not (abs(across) > 0 and spread > 0):
        raise GeometryError("the fixes, or the map's points, are in one place")
    scale = 1.0 if rigid else abs(across) / spread
    # A turn about the map's +y is one about up.
    rotation = ENU_R_YUP @ yaw_rotation(float(np.angle(across)))
    shift = mean - scale * np.exp(1j * np.angle(across)) * mean_of_map
    return Sim3(scale, rotation, np.array([shift.real, shift.imag, 0.0]))
