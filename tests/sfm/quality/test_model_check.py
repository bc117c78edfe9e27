"""Models against VIO: which frames move otherwise, in any gauge, and what isn't held against them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from groundwalk.sfm.pairs.odometry import odometry
from groundwalk.sfm.quality.model_check import check_models

_GAUGE = Sim3(0.37, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -7.0, 1.0]))
_EACH = 40


def _walks(rng: np.random.Generator) -> Array:
    """Poses (2 * _EACH, 4, 4) of two walks, 0.8 m a frame."""
    turn = np.cumsum(rng.normal(0, 0.2, (2, _EACH)), axis=1)
    step = 0.8 * np.stack([np.cos(turn), 0.02 * rng.normal(size=turn.shape), np.sin(turn)], axis=2)
    yaw = -turn + 0.5 * np.sin(np.arange(_EACH) / 5)
    level = yaw_rotation(yaw) @ np.diag([1.0, -1.0, -1.0])
    return make_pose(level, np.cumsum(step, axis=1)).reshape(-1, 4, 4)


def _consistent(sfm: Array, vio: Array, model: np.ndarray | None = None, jumps: tuple = ()) -> np.ndarray:
    return _checked(sfm, vio, model, jumps)[0]


def _checked(sfm: Array, vio: Array, model: np.ndarray | None = None, jumps: tuple = ()) -> tuple[np.ndarray, str]:
    session = np.repeat(np.array(["a", "b"], object), _EACH)
    t_ns = np.tile(np.arange(_EACH) * 1_000_000_000, 2)
    known = odometry(session, session, t_ns, vio, -vio[:, 1, :3], jumps)
    number = np.zeros(2 * _EACH, np.int64) if model is None else model
    sfm = np.where((number >= 0)[:, None, None], sfm, np.nan)
    return check_models(sfm, number, known)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def _noisy(poses: Array, rng: np.random.Generator) -> Array:
    turned = Rotation.from_rotvec(0.002 * rng.normal(size=(len(poses), 3))).as_matrix()
    return make_pose(turned @ poses[:, :3, :3], poses[:, :3, 3] + 0.01 * rng.normal(size=(len(poses), 3)))


def test_a_right_model_agrees_in_any_gauge_and_models_need_share_none(rng: np.random.Generator) -> None:
    poses = _walks(rng)
    sfm = _noisy(poses, rng)
    assert _consistent(_GAUGE.poses(sfm), poses).all()
    two = sfm.copy()
    two[25:] = _GAUGE.poses(sfm[25:])
    model = np.repeat([1, 0], [25, 2 * _EACH - 25])
    assert _consistent(two, poses, model).all()
    # As one model the same poses are torn apart, but for the walk that is whole.
    torn = _consistent(two, poses)
    assert not torn[:_EACH].all() and torn[_EACH:].all()


def test_frames_without_a_model_or_without_vio(rng: np.random.Generator) -> None:
    poses = _walks(rng)
    model = np.zeros(2 * _EACH, np.int64)
    model[[3, 50]] = -1
    vio = poses.copy()
    vio[10:20] = np.nan
    consistent = _consistent(_GAUGE.poses(_noisy(poses, rng)), vio, model)
    assert consistent.tolist() == (model >= 0).tolist()
    assert _consistent(poses, np.full_like(poses, np.nan)).all()


def test_a_scale_of_ones_own_and_a_known_jump_are_vios_not_the_models(rng: np.random.Generator) -> None:
    poses = _walks(rng)
    vio = poses.copy()
    vio[_EACH:, :3, 3] *= 1.1
    vio[20:_EACH, :3, 3] += [4.0, 0.0, 1.0]
    sfm = _GAUGE.poses(_noisy(poses, rng))
    assert _consistent(sfm, vio, jumps=(("a", 20_000_000_000, 4.1, 0.0),)).all()
    # Unknown, the same jump is a place that the model has folded together.
    assert not _consistent(sfm, vio).any()


def test_a_model_of_folded_places_has_no_right_frame(rng: np.random.Generator) -> None:
    poses = _walks(rng)
    half = _EACH // 2
    poses[half:_EACH] = poses[:half]
    vio = poses.copy()
    vio[half:_EACH, :3, 3] += [30.0, 0.0, 0.0]
    model = np.repeat([0, 1], _EACH)
    consistent = _consistent(_noisy(poses, rng), vio, model)
    assert not consistent[:_EACH].any() and consistent[_EACH:].all()


def test_a_single_wrong_frame_is_wrong_alone(rng: np.random.Generator) -> None:
    poses = _walks(rng)
    sfm = _noisy(poses, rng)
    sfm[12, :3, 3] += [1.5, 0.0, 0.0]
    assert np.flatnonzero(~_consistent(_GAUGE.poses(sfm), poses)).tolist() == [12]


def test_turns_that_are_all_too_small_are_the_focal_lengths_fault_where_no_more_is_wrong(
    rng: np.random.Generator,
) -> None:
    poses = _walks(rng)
    vio, sfm = poses.copy(), poses.copy()
    turns = Rotation.from_matrix(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    for k in range(1, _EACH):
        vio[k, :3, :3] = vio[k - 1, :3, :3] @ Rotation.from_rotvec(1.12 * turns[k - 1].as_rotvec()).as_matrix()
    fault = _checked(poses, vio)[1]
    assert fault.startswith("the images of session a turn 0.89 times as far as its VIO") and "session b" not in fault
    assert not _checked(_noisy(poses, rng), poses)[1]
    sfm[_EACH:, :3, 3] = sfm[_EACH + rng.permutation(_EACH), :3, 3]
    consistent, fault = _checked(sfm, vio)
    assert not consistent[_EACH:].all() and not fault
