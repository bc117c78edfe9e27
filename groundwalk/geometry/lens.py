"""Lens distortion in OpenCV's convention, on image coordinates at unit focal length about the principal point.

x_d = x radial + 2 p1 x y + p2 (r^2 + 2 x^2) and alike for y, radial = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 +
k5 r^4 + k6 r^6) (OpenCV, camera calibration, "Detailed description"). Coefficients are up to eight numbers in OpenCV's
order k1, k2, p1, p2, k3, k4, k5, k6, of all points (k,) or of each (M, k).

A fisheye lens is described by the same coefficients, fitted to its own formula over the image.
"""

import numpy as np
from numpy.typing import ArrayLike

from groundwalk.geometry import Array, GeometryError

_MAX_STEPS, _PRECISION = 50, 1e-13
_ANGLES, _MAX_ANGLE_DEG = 2000, 80.0
_FIT_STEPS = 10


def distort(ideal_M2: Array, coefficients: ArrayLike) -> Array:
    """Where the lens puts ideal image points (M, 2): distorted points (M, 2)."""
    return distort_with_slope(ideal_M2, coefficients)[0]


def distort_with_slope(ideal_M2: Array, coefficients: ArrayLike) -> tuple[Array, Array]:
    """Distorted points (M, 2), and their derivatives by the ideal ones (M, 2, 2)."""
    x, y = np.asarray(ideal_M2, float).T
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(coefficients).T
    r2 = x * x + y * y
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    # The derivative of `radial` by r^2, twice.
    bend = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / below
    cross = bend * x * y + 2 * p1 * x + 2 * p2 * y
    slope = np.empty((len(x), 2, 2))
    slope[:, 0, 0] = radial + bend * x * x + 2 * p1 * y + 6 * p2 * x
    slope[:, 1, 1] = radial + bend * y * y + 6 * p1 * y + 2 * p2 * x
    slope[:, 0, 1] = slope[:, 1, 0] = cross
    tangential_x = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    tangential_y = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + tangential_x, y * radial + tangential_y], axis=1), slope


def slope_by_numerator(ideal_M2: Array, coefficients: ArrayLike) -> Array:
    """Derivatives of the distorted points (M, 2) by k1, k2, k3: (M, 2, 3)."""
    ideal = np.asarray(ideal_M2, float)
    k4, k5, k6 = _eight(coefficients).T[5:]
    r2 = np.sum(ideal * ideal, axis=1)
    powers = np.stack([r2, r2**2, r2**3], axis=1) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))[:, None]
    return ideal[:, :, None] * powers[:, None, :]


def undistort(distorted_M2: Array, coefficients: ArrayLike) -> Array:
    """The ideal image points (M, 2) behind distorted ones (M, 2), the inverse of `distort`, by Newton's method.

    NaN where the lens has no such point.
    """
    distorted = np.asarray(distorted_M2, float).reshape(-1, 2)
    eight = _eight(coefficients)
    ideal = distorted.copy()
    if not eight.any():
        return ideal
    for _ in range(_MAX_STEPS):
        again, slope = distort_with_slope(ideal, eight)
        miss = again - distorted
        if not len(miss) or np.nanmax(np.abs(miss), initial=0.0) < _PRECISION:
            return ideal
        determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ideal[:, 0] -= (slope[:, 1, 1] * miss[:, 0] - slope[:, 0, 1] * miss[:, 1]) / determinant
            ideal[:, 1] -= (slope[:, 0, 0] * miss[:, 1] - slope[:, 1, 0] * miss[:, 0]) / determinant
    ideal[~(np.abs(distort(ideal, eight) - distorted) < 1e-9).all(axis=1)] = np.nan
    return ideal


def fold_radius(coefficients: ArrayLike) -> float:
    """The ideal radius, in focal lengths, beyond which the polynomial puts points nearer to the middle again, as no
    lens does; infinity where it doesn't up to 80 degrees from the axis. Tangential distortion is left out."""
    radius = np.tan(np.linspace(0, np.radians(_MAX_ANGLE_DEG), _ANGLES))
    radial = np.where(np.isin(np.arange(8), (2, 3)), 0.0, _eight(coefficients))
    turns = np.flatnonzero(~(np.diff(distort(np.stack([radius, 0 * radius], axis=1), radial)[:, 0]) > 0))
    return float(radius[turns[0]]) if len(turns) else np.inf


def k1_k2_of_k3(radius: float) -> Array:
    """The k1 and k2 (2,) that come nearest to k3 = 1, in least squares over a disc of `radius` (focal lengths)."""
    return np.array([-10 / 21 * radius**4, 10 / 7 * radius**2])


def rational_of_fisheye(fisheye_4: ArrayLike, radius: float, tolerance: float) -> Array:
    """Coefficients (8,) of the rational model that are a fisheye lens's within an image radius, in focal lengths.

    `fisheye_4` are k1 to k4 of Kannala and Brandt's polynomial, theta_d = theta (1 + k1 theta^2 + k2 theta^4 + ...), as
    in OpenCV's fisheye module and COLMAP's OPENCV_FISHEYE. GeometryError where the lens sees further than 80 degrees
    from its axis, folds back, or the fit is off by more than `tolerance` focal lengths.
    """
    theta = np.linspace(0, np.radians(_MAX_ANGLE_DEG), _ANGLES)[1:]
    image = theta * np.polynomial.polynomial.polyval(theta**2, [1.0, *np.asarray(fisheye_4, float)])
    beyond = np.flatnonzero(~(image < radius))
    if not len(beyond):
        raise GeometryError(f"the fisheye lens sees further than {_MAX_ANGLE_DEG:g} degrees from its axis")
    theta, image = theta[: beyond[0] + 1], image[: beyond[0] + 1]
    if not (np.diff(image) > 0).all():
        raise GeometryError("the fisheye lens's polynomial folds back within the image")
    ideal = np.tan(theta)
    on_axis = np.stack([ideal, 0 * ideal], axis=1)
    for terms in range(4):  # as few of k4 to k6 as will do: superfluous ones come out large and against each other
        eight = _fitted_rational(ideal, image / ideal, terms)
        miss = np.abs(distort(on_axis, eight)[:, 0] - image).max()
        if miss <= tolerance:
            return eight
    raise GeometryError(f"OpenCV's k1 to k6 can't describe the fisheye lens: off by {miss:.2g} focal lengths")


def _fitted_rational(ideal: Array, ratio: Array, terms: int) -> Array:
    """Coefficients (8,), of k4 to k6 the first `terms`, whose radial factor at radii `ideal` (N,) is `ratio` (N,)."""
    powers = np.stack([ideal**2, ideal**4, ideal**6], axis=1)
    equations = np.hstack([powers, -ratio[:, None] * powers[:, :terms]])
    below = np.ones(len(ideal))
    for _ in range(_FIT_STEPS):  # linear but for the denominator, whose last value weighs the equations
        scaled = equations * (ideal / below)[:, None]
        size = np.linalg.norm(scaled, axis=0)
        fitted = np.linalg.lstsq(scaled / size, (ratio - 1) * ideal / below, rcond=None)[0] / size
        below = np.maximum(np.abs(1 + powers[:, :terms] @ fitted[3:]), 1e-3)
    eight = np.zeros(8)
    eight[[0, 1, 4]], eight[5 : 5 + terms] = fitted[:3], fitted[3:]
    return eight


def max_shift(coefficients: ArrayLike, other: ArrayLike, extent_xy: tuple[float, float]) -> float:
    """How far apart two lenses put any ideal point of an image, at unit focal length.

    `extent_xy` is the image's half width and half height at unit focal length.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, 17) * extent_xy[0], np.linspace(-1, 1, 17) * extent_xy[1])
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    return float(np.linalg.norm(distort(grid, coefficients) - distort(grid, other), axis=1).max())


def _eight(coefficients: ArrayLike) -> Array:
    short = np.asarray(coefficients, float)
    eight = np.zeros((*short.shape[:-1], 8))
    eight[..., : short.shape[-1]] = short
    return eight
