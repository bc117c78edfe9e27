"""Lines of rooms tell whether +y is up; other lines tell nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array
from groundwalk.geometry.vanishing import LineAxes, line_axes, up_by_lines

ROOM = np.eye(3)


def lines(directions: Array, seed: int, count: int = 600, stray: float = 0.4) -> tuple[Array, Array]:
    """Normals (N, 3) of lines along directions (K, 3), off by half a degree, and a part along any."""
    rng = np.random.default_rng(seed)
    along = directions[rng.integers(0, len(directions), count)]
    along = np.where(rng.random((count, 1)) < stray, rng.normal(size=(count, 3)), along)
    normals = np.cross(along, rng.normal(size=(count, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals += rng.normal(0, np.radians(0.5), normals.shape)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), rng.uniform(0.1, 0.5, count)


def tilted(degrees: float, seed: int) -> Array:
    """Any rotation that takes +y so far from itself."""
    rng = np.random.default_rng(seed)
    about, yaw = rng.uniform(0, 2 * np.pi, 2)
    tilt = Rotation.from_rotvec(np.radians(degrees) * np.array([np.cos(about), 0, np.sin(about)]))
    return np.asarray((tilt * Rotation.from_rotvec([0, yaw, 0])).as_matrix())


def judged(directions: Array, rotation: Array, seed: int) -> LineAxes:
    normals, lengths = lines(directions, seed)
    return line_axes(normals @ rotation.T, lengths)


@pytest.mark.parametrize("seed", range(2))
def test_a_room_tells_whether_y_is_up_and_how_far_it_is_tilted(seed: int) -> None:
    assert judged(ROOM, tilted(0.5, seed), seed).is_up is True
    for degrees in (10, 20, 40):
        found = judged(ROOM, tilted(degrees, seed), seed)
        assert found.is_up is False
        assert np.degrees(found.tilt) == pytest.approx(degrees, abs=1)


@pytest.mark.parametrize("degrees", [0.0, 25.0])
def test_what_has_no_three_axes_at_right_angles_tells_nothing(degrees: float) -> None:
    board, shrubs = ROOM[[0, 2]], np.random.default_rng(1).normal(size=(300, 3))
    for directions in (board, shrubs):
        assert judged(directions, tilted(degrees, 3), 5).is_up is None


def test_a_slanted_thing_in_an_upright_room_tells_nothing_against_y() -> None:
    slanted = Rotation.from_euler("xz", [50, 30], degrees=True).as_matrix()
    assert judged(np.concatenate([slanted, ROOM]), np.eye(3), 5).is_up is None


def cameras(seed: int, down_deg: float = 10.0, roll_deg: float = 0.0) -> Array:
    """World rotations (24, 3, 3) of cameras in an upright world that look around, down and, by a little, sideways."""
    rng = np.random.default_rng(seed)
    yaw, down, roll = rng.uniform(-60, 60, 24), rng.normal(down_deg, 5, 24), rng.normal(roll_deg, 3, 24)
    level = np.diag([1.0, -1.0, -1.0])  # x right, y down, z forward
    turned = Rotation.from_euler("YXZ", np.column_stack([yaw, -down, -roll]), degrees=True)
    return np.asarray(turned.as_matrix() @ level)


@pytest.mark.parametrize("seed", range(3))
def test_up_is_the_axis_that_upright_cameras_turn_about(seed: int) -> None:
    normals, lengths = lines(ROOM, seed)
    world = Rotation.random(random_state=seed).as_matrix()
    found = up_by_lines(normals @ world.T, lengths, world @ cameras(seed))
    assert found is not None and np.degrees(np.arccos(found @ world[:, 1])) < 0.3


@pytest.mark.parametrize("roll_deg, down_deg", [(90, 10), (0, 80)], ids=["on their side", "looking down"])
def test_cameras_that_are_not_upright_tell_no_vertical(roll_deg: float, down_deg: float) -> None:
    normals, lengths = lines(ROOM, 1)
    assert up_by_lines(normals, lengths, cameras(1, down_deg, roll_deg)) is None


def test_without_a_room_there_is_no_vertical() -> None:
    shrubs = np.random.default_rng(1).normal(size=(300, 3))
    assert up_by_lines(*lines(shrubs, 5), cameras(5)) is None
