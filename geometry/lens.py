"""Lens distortion in OpenCV's convention, on image coordinates at unit focal length about the principal point.

x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2) and alike for y (OpenCV, camera calibration, "Detailed
description"); further coefficients k3, k4, k5, k6 of the rational model follow k1, k2, p1, p2.
"""

import cv2
import numpy as np
from numpy.typing import ArrayLike

from geometry.poses import Array

_ITERATIONS, _PRECISION = 100, 1e-12


def distort(ideal_M2: Array, coefficients: ArrayLike) -> Array:
    """Where the lens puts ideal image points (M, 2): distorted points (M, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(coefficients)
    x, y = np.asarray(ideal_M2, float).T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def undistort(distorted_M2: Array, coefficients: ArrayLike) -> Array:
    """The ideal image points (M, 2) behind distorted ones (M, 2), the inverse of `distort`."""
    points = np.ascontiguousarray(distorted_M2, float).reshape(-1, 1, 2)
    eight = _eight(coefficients)
    if not len(points) or not eight.any():
        return points.reshape(-1, 2).copy()
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, _PRECISION)
    ideal = cv2.undistortPointsIter(points, np.eye(3), eight, np.eye(3), np.eye(3), stop)
    return np.asarray(ideal, float).reshape(-1, 2)


def largest_shift(coefficients: ArrayLike, other: ArrayLike, extent_xy: tuple[float, float]) -> float:
    """How far apart two lenses put any ideal point of an image, at unit focal length.

    `extent_xy` is the image's half width and half height at unit focal length.
    """
    x, y = np.meshgrid(np.linspace(-1, 1, 17) * extent_xy[0], np.linspace(-1, 1, 17) * extent_xy[1])
    grid = np.stack([x.ravel(), y.ravel()], axis=1)
    return float(np.linalg.norm(distort(grid, coefficients) - distort(grid, other), axis=1).max())


def _eight(coefficients: ArrayLike) -> Array:
    """Coefficients (up to 8) as k1, k2, p1, p2, k3, k4, k5, k6."""
    eight = np.zeros(8)
    given = np.asarray(coefficients, float).ravel()
    eight[: len(given)] = given
    return eight
