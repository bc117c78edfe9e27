"""Pairs against VIO: right pairs agree in any gauge, wrong ones are named, and drift is allowed for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose, relative, yaw_rotation
from groundwalk.sfm.pairs.odometry import (
    Odometry,
    compare_with_vio,
    drift_between,
    odometry,
    without_tilted,
)

_WIDE = np.radians(10.0)


def _walk(frames: int, seed: int) -> tuple[Array, np.ndarray, np.ndarray]:
    """Poses a metre apart that look about, their sessions of ten frames, and times a second apart."""
    rng = np.random.default_rng(seed)
    rotation = yaw_rotation(rng.uniform(-0.4, 0.4, frames)) @ np.diag([1.0, -1.0, -1.0])
    position = np.stack([np.arange(frames), np.full(frames, 1.5), np.zeros(frames)], axis=1)
    session = (np.arange(frames) // 10).astype(str).astype(object)
    return make_pose(rotation, position), session, np.arange(frames) * 1_000_000_000


def _odometry(poses: Array, session: np.ndarray, t_ns: np.ndarray, jumps: tuple = ()) -> Odometry:
    return odometry(session, session, t_ns, poses, -poses[:, 1, :3], jumps)


def _unit(a_T_b: Array) -> Array:
    unit = a_T_b.copy()
    unit[:, :3, 3] /= np.linalg.norm(unit[:, :3, 3], axis=1, keepdims=True)
    return unit


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), yaw=st.floats(-3, 3))
def test_true_relative_poses_agree_wherever_the_vio_frame_lies(seed: int, yaw: float) -> None:
    poses, session, t_ns = _walk(20, seed)
    pairs = np.array([[0, 1], [0, 3], [2, 7], [3, 15], [11, 12]])
    vio = _odometry(make_pose(yaw_rotation(yaw), [50.0, 3.0, -9.0]) @ poses, session, t_ns)
    found = compare_with_vio(pairs, _unit(relative(*poses[pairs.T])), np.full(5, _WIDE), vio)
    assert (found["reason"] == "").all()
    assert found[["rotation", "direction"]].max().max() < 1e-6
    # Gravity is known across sessions, the motion isn't.
    assert found["gravity"].notna().all()
    assert found["rotation"].isna().tolist() == [False, False, False, True, False]


@pytest.mark.parametrize(
    ("turn", "reason"),
    [([0.0, 30.0, 0.0], "rotation"), ([0.0, 0.0, 30.0], "rotation"), ([0.0, 0.0, 0.0], "direction of motion")],
)
def test_a_wrong_pair_of_a_session_is_named(turn: list[float], reason: str) -> None:
    poses, session, t_ns = _walk(10, 1)
    pairs = np.array([[0, 2]])
    a_T_b = _unit(relative(*poses[pairs.T]))
    a_T_b[:, :3, :3] = a_T_b[:, :3, :3] @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    if reason == "direction of motion":
        a_T_b[:, :3, 3] *= -1
    vio = _odometry(poses, session, t_ns)
    assert compare_with_vio(pairs, a_T_b, np.full(1, _WIDE), vio)["reason"].tolist() == [reason]


def test_across_sessions_a_pair_that_tilts_gravity_is_named_and_a_turn_is_not() -> None:
    poses, session, t_ns = _walk(20, 2)
    pairs = np.array([[3, 15], [3, 15]])
    a_T_b = _unit(relative(*poses[pairs.T]))
    world_R_a = poses[3, :3, :3]
    for row, about in enumerate(([0, 0, 1], [0, 1, 0])):
        turned = Rotation.from_rotvec(np.radians(20) * np.array(about)).as_matrix()
        a_T_b[row, :3, :3] = world_R_a.T @ turned @ world_R_a @ a_T_b[row, :3, :3]
    vio = _odometry(poses, session, t_ns)
    assert compare_with_vio(pairs, a_T_b, np.full(2, _WIDE), vio)["reason"].tolist() == ["gravity", ""]


@pytest.mark.parametrize("first", [0, 1])
def test_a_session_with_another_gravity_is_no_reason_against_its_pairs(first: int) -> None:
    poses, session, t_ns = _walk(20, 2)
    pairs = np.array([[a, b][:: 1 - 2 * first] for a in range(10) for b in (11, 14, 18)])
    a_T_b = _unit(relative(*poses[pairs.T]))
    tilted = poses.copy()
    tilted[10:, :3] = Rotation.from_euler("xz", [40, 15], degrees=True).as_matrix() @ poses[10:, :3]
    vio = _odometry(tilted, session, t_ns)
    wide = np.full(len(pairs), _WIDE)
    assert (compare_with_vio(pairs, a_T_b, wide, vio)["reason"] == "gravity").all()
    vio = without_tilted(vio, pairs, a_T_b)
    assert vio.tilted == {frozenset({"0", "1"})}
    assert (compare_with_vio(pairs, a_T_b, wide, vio)["reason"] == "").all()

    # Wrong pairs each say another direction, and gravity that is right is no difference.
    right = _odometry(poses, session, t_ns)
    a_T_b[::2, :3, :3] = Rotation.random(len(pairs[::2]), rng=np.random.default_rng(0)).as_matrix()
    assert not without_tilted(right, pairs, a_T_b).tilted


def test_drift_grows_with_the_path_and_a_jump_adds_to_it() -> None:
    poses, session, t_ns = _walk(10, 3)
    pairs = np.array([[0, 1], [0, 4], [4, 6]])
    calm = drift_between(_odometry(poses, session, t_ns), pairs)
    jumped = drift_between(_odometry(poses, session, t_ns, (("0", int(t_ns[5]), 4.6, 0.2),)), pairs)
    assert calm[0] == pytest.approx([0.13, 0.22, 0.16])
    assert calm[1] == pytest.approx(np.radians(3 + 2.5 * np.sqrt([1, 4, 2])))
    assert jumped[0] - calm[0] == pytest.approx([0, 0, 4.6])
    assert jumped[1] - calm[1] == pytest.approx([0, 0, 0.2])


def test_frames_without_vio_are_compared_with_nothing() -> None:
    poses, session, t_ns = _walk(10, 4)
    poses[2] = np.nan
    pairs = np.array([[1, 2], [2, 3]])
    vio = _odometry(poses, session, t_ns)
    assert np.isfinite(vio.travelled_m).all()
    found = compare_with_vio(pairs, np.tile(np.eye(4), (2, 1, 1)), np.full(2, _WIDE), vio)
    assert (found["reason"] == "").all() and found["rotation"].isna().all()
