"""How far matches of two images lie from what a relative pose allows."""

import numpy as np

from groundwalk.geometry.poses import Array, skew


def sampson_px(a_T_b: Array, ray_a: Array, ray_b: Array, focal_a: Array, focal_b: Array) -> Array:
    """Sampson's distance of matches in pixels, (M,); NaN where the pose has no translation.

    `a_T_b` (M, 4, 4), or (1, 4, 4) for all, relative poses of any scale, rays (M, 3) with z = 1 in each camera, focal
    lengths (M, 2) or (2,) in pixels along x and y. First-order distance of a match from the epipolar constraint
    (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., eq. 11.9), in the pixels of both images.
    """
    return epipolar_px(essential(a_T_b), ray_a, ray_b, focal_a, focal_b)


def essential(a_T_b: Array) -> Array:
    """The essential matrices (M, 3, 3) of relative poses (M, 4, 4), with ray_b^T essential ray_a = 0."""
    return np.swapaxes(skew(a_T_b[:, :3, 3]) @ a_T_b[:, :3, :3], 1, 2)


def epipolar_px(essential: Array, ray_a: Array, ray_b: Array, focal_a: Array, focal_b: Array) -> Array:
    """As `sampson_px`, by essential matrices (M, 3, 3), or (3, 3) for all, with ray_b^T essential ray_a = 0."""
    line_a = np.einsum("...ji,...j->...i", essential, ray_b)
    line_b = np.einsum("...ij,...j->...i", essential, ray_a)
    gradient = np.sum((line_a[:, :2] / focal_a) ** 2, axis=1)
    gradient += np.sum((line_b[:, :2] / focal_b) ** 2, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.abs(np.sum(ray_a * line_a, axis=1)) / np.sqrt(gradient)
