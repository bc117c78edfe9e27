"""Rotations that gravity decides: cameras are x right, y down, z forward; in the map gravity points to -y.

Needs NumPy alone, as a phone's runtime does.
"""

import numpy as np

from groundwalk.geometry import Array

_MAP_DOWN = np.array([0.0, -1.0, 0.0])


def gravity_in_camera(world_T_cam: Array) -> Array:
    """Unit vectors of gravity in camera axes (..., 3), for worlds whose +y is up."""
    return -world_T_cam[..., 1, :3]


def upright_rotation(gravity: Array) -> Array:
    """cam_R_upright (..., 3, 3) of gravity (..., 3), down in camera axes.

    Upright is the camera turned about its viewing direction until gravity has no part to the side. A camera whose
    gravity isn't known (NaN) is left as it is.
    """
    roll = np.arctan2(-gravity[..., 0], gravity[..., 1])
    roll = np.where(np.isfinite(roll), roll, 0.0)
    rotation = np.zeros((*roll.shape, 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(roll)
    rotation[..., 1, 0] = np.sin(roll)
    rotation[..., 0, 1] = -rotation[..., 1, 0]
    rotation[..., 2, 2] = 1.0
    return rotation


def with_tilt_of_gravity(map_R_cam: Array, gravity: Array) -> Array:
    """map_R_cam (..., 3, 3) after the smallest turn that brings gravity (..., 3), down in camera axes, to the map's
    down. Where gravity isn't known (NaN), the rotation is left as it is."""
    down = np.einsum("...ij,...j->...i", map_R_cam, gravity)
    down /= np.maximum(np.linalg.norm(down, axis=-1, keepdims=True), 1e-12)
    axis = np.cross(down, _MAP_DOWN)
    sine = np.linalg.norm(axis, axis=-1)[..., None, None]
    across = np.cross(np.eye(3), axis[..., None, :] / np.maximum(sine, 1e-12))  # the matrix of the product axis x
    turn = np.eye(3) + sine * across + (1.0 - (down @ _MAP_DOWN)[..., None, None]) * across @ across
    known = np.isfinite(down).all(axis=-1)[..., None, None]
    return np.asarray(np.where(known, turn, np.eye(3)) @ map_R_cam)
