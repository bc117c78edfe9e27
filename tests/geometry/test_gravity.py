"""Rotations that gravity decides, against scipy and their definitions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.gravity import upright_rotation, with_tilt_of_gravity

DOWN = np.array([0.0, -1.0, 0.0])


def test_upright_is_a_turn_about_the_viewing_direction_that_leaves_gravity_no_part_to_the_side() -> None:
    rng = np.random.default_rng(0)
    gravity = Rotation.random(20, rng=rng).apply(DOWN)
    cam_R_upright = upright_rotation(gravity)
    seen = np.einsum("nji,nj->ni", cam_R_upright, gravity)
    assert seen[:, 0] == pytest.approx(0, abs=1e-12)
    assert (seen[:, 1] >= 0).all()
    turns = Rotation.from_matrix(cam_R_upright).as_rotvec()
    assert turns[:, :2] == pytest.approx(0, abs=1e-12)


def test_gravity_decides_tilt_with_the_smallest_turn() -> None:
    rng = np.random.default_rng(1)
    map_R_cam = Rotation.random(20, rng=rng)
    tilt = Rotation.from_rotvec(0.3 * rng.standard_normal((20, 3)) * [1, 0, 1])  # about the map's horizontal axes
    gravity = map_R_cam.inv().apply(DOWN)
    answered = tilt * map_R_cam
    levelled = with_tilt_of_gravity(answered.as_matrix(), gravity)
    assert np.einsum("nij,nj->ni", levelled, gravity) == pytest.approx(np.tile(DOWN, (20, 1)), abs=1e-9)
    assert levelled == pytest.approx(map_R_cam.as_matrix(), abs=1e-9)


def test_one_frame_and_many_and_unknown_gravity() -> None:
    gravity = np.array([[0.3, 0.9, 0.1], [np.nan] * 3])
    map_R_cam = Rotation.random(2, rng=np.random.default_rng(2)).as_matrix()
    upright, levelled = upright_rotation(gravity), with_tilt_of_gravity(map_R_cam, gravity)
    assert (upright[1] == np.eye(3)).all()
    assert (levelled[1] == map_R_cam[1]).all()
    assert (upright_rotation(gravity[0]) == upright[0]).all()
    assert with_tilt_of_gravity(map_R_cam[0], gravity[0]) == pytest.approx(levelled[0], abs=1e-15)
