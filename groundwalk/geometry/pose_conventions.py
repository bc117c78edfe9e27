"""The usual mistakes in reading camera poses, each as what turns a pose read so into the right one, or back."""

from collections.abc import Callable

import numpy as np

from groundwalk.geometry.poses import (
    ARKIT_CAM_T_CAM,
    Array,
    inverse,
    make_pose,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

PoseChange = Callable[[Array], Array]
"""Takes poses world_T_cam (..., 4, 4) to others."""


def _on_arkit(change: PoseChange) -> PoseChange:
    """A mistake in reading the pose as the log has it, in ARKit's camera axes."""
    return lambda pose: change(pose @ ARKIT_CAM_T_CAM) @ ARKIT_CAM_T_CAM


def _axes(*signs: float) -> PoseChange:
    return lambda pose: pose @ np.diag([*signs, 1.0])


def _transposed(pose: Array) -> Array:
    return make_pose(np.swapaxes(pose[..., :3, :3], -1, -2), pose[..., :3, 3])


def _rolled(places: int) -> PoseChange:
    def change(pose: Array) -> Array:
        q = np.roll(quaternion_from_matrix(pose[..., :3, :3]), places, axis=-1)
        return make_pose(matrix_from_quaternion(q), pose[..., :3, 3])

    return change


def turned_image(quarters: int) -> PoseChange:
    """The image is turned by quarters clockwise against the pose."""
    c, s = np.cos(quarters * np.pi / 2), np.sin(quarters * np.pi / 2)
    turn = make_pose([[c, s, 0], [-s, c, 0], [0, 0, 1]], [0.0, 0.0, 0.0])
    return lambda pose: pose @ turn


POSE_CONVENTIONS: tuple[tuple[str, PoseChange], ...] = (
    ("camera y and z axes have the other sign (ARKit's or OpenGL's for OpenCV's, or back)", _axes(1, -1, -1)),
    ("camera x and z axes have the other sign", _axes(-1, 1, -1)),
    ("image is turned by 180 degrees against the pose", _axes(-1, -1, 1)),
    ("poses are world to camera", _on_arkit(inverse)),
    ("poses are world to camera, in OpenCV's axes", inverse),
    ("rotations are transposed", _on_arkit(_transposed)),
    ("rotations are transposed, in OpenCV's axes", _transposed),
    ("quaternions are w first, read as w last", _on_arkit(_rolled(-1))),
    ("quaternions are w last, read as w first", _on_arkit(_rolled(1))),
    ("quaternions are w first, read as w last, in OpenCV's axes", _rolled(-1)),
    ("quaternions are w last, read as w first, in OpenCV's axes", _rolled(1)),
    ("image is turned by 90 degrees clockwise against the pose", turned_image(1)),
    ("image is turned by 90 degrees counter-clockwise against the pose", turned_image(3)),
)
