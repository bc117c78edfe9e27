"""The pose of a camera that odometry carries on from a keyframe, and how far off it may be."""

from math import atan2, cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.matrices import add_product
from groundwalk.geometry.poses import Array


class CarriedPose(NamedTuple):
    """map_T_cam and map_T_vio (4, 4), and the covariance (6, 6) of the pose's error in the map frame, rotation (rad)
    before translation (m)."""

    map_T_cam: Array
    map_T_vio: Array
    covariance: Array


def yaw_and_lean(rotation: Array) -> tuple[float, tuple[float, float]]:
    """The yaw (rad) nearest to a rotation (3, 3), and the rest of it: what is turned about x and z after the yaw."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    yaw = atan2(c - g, a + i)
    # rest = rotation @ yaw_rotation(-yaw) has no yaw left; its axis lies in the horizontal plane.
    cosine, sine = cos(yaw), sin(yaw)
    x, z = h - (f * cosine - d * sine), (d * cosine + f * sine) - b
    length = sqrt(x * x + z * z)
    angle = atan2(length, a * cosine + c * sine + e + i * cosine - g * sine - 1)
    scale = angle / length if length > 1e-12 else 0.5
    return yaw, (x * scale, z * scale)


@compiled
def carried_pose(
    state: Array, map_R_vio: Array, vio_T_cam: Array, keyframe: Array, bound: Array, added: Array
) -> CarriedPose:
    """state (4,): the camera's position and yaw. keyframe (4,): those of the keyframe that it is carried from, bound
    (4, 4) their covariance in map axes, added (4,) what the way since adds to its variances. The covariance's tilt is
    left out."""
    map_T_cam, map_T_vio, covariance = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((6, 6))
    add_product(map_R_vio, vio_T_cam, map_T_cam, (3, 3, 3))
    map_T_cam[3, 3] = map_T_vio[3, 3] = 1.0
    for j in range(3):
        map_T_cam[j, 3] = map_T_vio[j, 3] = state[j]
        for k in range(3):
            map_T_vio[j, k] = map_R_vio[j, k]
            map_T_vio[j, 3] -= map_R_vio[j, k] * vio_T_cam[k, 3]
    # The keyframe's yaw turns the way since.
    way = np.zeros(3)
    way[0], way[2] = state[2] - keyframe[2], keyframe[0] - state[0]
    for j in range(3):
        covariance[1, 3 + j] = covariance[3 + j, 1] = bound[j, 3] + way[j] * bound[3, 3]
        for k in range(3):
            covariance[3 + j, 3 + k] = bound[j, k] + way[j] * bound[3, k] + bound[j, 3] * way[k]
            covariance[3 + j, 3 + k] += way[j] * bound[3, 3] * way[k]
        covariance[3 + j, 3 + j] += added[j]
    covariance[1, 1] = bound[3, 3] + added[3]
    return CarriedPose(map_T_cam, map_T_vio, covariance)
