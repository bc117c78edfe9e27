"""Relative motions by images against odometry's: what each mistake looks like."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.consistency.motions import MIRRORED, UNRELATED, UPSIDE_DOWN, compare_motions
from groundwalk.geometry.poses import make_pose, relative


def walk(rng: np.random.Generator, count: int = 60) -> np.ndarray:
    """Camera poses of somebody who walks and looks around."""
    turn = np.cumsum(np.radians(rng.normal(0, 12, count)))
    yaw = Rotation.from_euler("y", turn[:, None] + 0.5 * np.sin(np.arange(count) / 4)[:, None])
    pitch = Rotation.from_euler("x", 0.15 * rng.normal(size=(count, 1)))
    steps = np.stack([np.sin(turn), np.zeros(count), np.cos(turn)], axis=1)
    return make_pose((yaw * pitch).as_matrix(), np.cumsum(steps, axis=0))


def seen(world_T_cam: np.ndarray, rng: np.random.Generator, scale: float = 0.3) -> np.ndarray:
    """Relative poses of neighbours as a model has them: another scale, a little noise."""
    motions = relative(world_T_cam[:-1], world_T_cam[1:])
    motions[:, :3, :3] = motions[:, :3, :3] @ Rotation.from_rotvec(0.001 * rng.normal(size=(59, 3))).as_matrix()
    motions[:, :3, 3] *= scale
    return motions


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


@pytest.mark.parametrize("common_scale", [True, False])
def test_right_images_agree_and_turn_as_odometry_does(rng: np.random.Generator, common_scale: bool) -> None:
    poses = walk(rng)
    found = compare_motions(seen(poses, rng), relative(poses[:-1], poses[1:]), common_scale=common_scale)
    assert found.explained == 1 and found.agree.all() and found.mistake is None
    assert found.turn_gain == pytest.approx(1, abs=4 * found.turn_gain_sd) and 0 < found.turn_gain_sd < 0.003


@pytest.mark.parametrize(("mistake", "mirror"), [(MIRRORED, [-1.0, 1, 1]), (UPSIDE_DOWN, [1.0, -1, 1])])
def test_mirrored_images_are_told_and_which_way(rng: np.random.Generator, mistake: str, mirror: list[float]) -> None:
    poses = walk(rng)
    images = np.diag([*mirror, 1.0]) @ seen(poses, rng) @ np.diag([*mirror, 1.0])
    found = compare_motions(images, relative(poses[:-1], poses[1:]), common_scale=True)
    assert found.mistake == mistake and found.mirrors[mistake] == 1


def test_shuffled_images_are_unrelated(rng: np.random.Generator) -> None:
    poses = walk(rng)
    images = seen(poses[rng.permutation(len(poses))], rng)
    found = compare_motions(images, relative(poses[:-1], poses[1:]), common_scale=True)
    assert found.mistake == UNRELATED and found.explained < 0.3


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_focal_length_shows_in_the_turns(rng: np.random.Generator, factor: float) -> None:
    """A focal length that is taken `factor` too long makes small turns so much smaller."""
    poses = walk(rng)
    images = seen(poses, rng)
    turns = Rotation.from_matrix(images[:, :3, :3]).as_rotvec() / [factor, factor, 1]
    images[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    found = compare_motions(images, relative(poses[:-1], poses[1:]), common_scale=True)
    assert found.mistake is None and found.turn_gain == pytest.approx(1 / factor, abs=0.01)


def test_too_few_or_idle_pairs_tell_nothing(rng: np.random.Generator) -> None:
    still = np.tile(np.eye(4), (30, 1, 1))
    found = compare_motions(still, still, common_scale=True)
    assert found.pairs == 0 and found.mistake is None and np.isnan(found.turn_gain) and found.agree.all()
    poses = walk(rng)
    few = compare_motions(seen(poses, rng)[:5], relative(poses[:-1], poses[1:])[:5], common_scale=True)
    assert few.pairs == 5 and few.mistake is None and np.isnan(few.turn_gain)
