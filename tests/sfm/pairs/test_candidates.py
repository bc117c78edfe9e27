"""Pair selection: properties on walks of random places and views."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from groundwalk.sfm.pairs.candidates import (
    first_origins,
    sequence_pairs,
    strongest_pairs,
    transitive_pairs,
    unique_pairs,
    view_overlap,
    vio_pairs,
    within_vio_limits,
)
from groundwalk.store.choices import PairOrigin

_REACH_M, _ANGLE_DEG, _PER_FRAME = 8.0, 60.0, 6


def _walk(frames: int, seed: int) -> tuple[np.ndarray, Array]:
    """Sessions of 50 frames, a second apart at walking speed, on a random path, looking about."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.3, frames))
    rotation = yaw_rotation(yaw)
    return np.arange(frames) // 50, make_pose(rotation, np.cumsum(1.2 * rotation[:, :, 2], axis=0))


def _vio_pairs(session: np.ndarray, poses: Array) -> np.ndarray:
    intrinsics = np.tile([500.0, 500.0, 320.0, 240.0], (len(session), 1))
    size = np.tile([640.0, 480.0], (len(session), 1))
    return vio_pairs(session, poses, intrinsics, size, _REACH_M, _ANGLE_DEG, _PER_FRAME)


def _assert_canonical(pairs: np.ndarray) -> None:
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert np.array_equal(pairs, np.unique(pairs, axis=0))


@settings(max_examples=20)
@given(frames=st.integers(2, 150), seed=st.integers(0, 1000))
def test_vio_pairs_keep_to_the_limits_and_to_the_session(frames: int, seed: int) -> None:
    session, poses = _walk(frames, seed)
    pairs = _vio_pairs(session, poses)
    _assert_canonical(pairs)
    a, b = pairs.T
    assert (session[a] == session[b]).all()
    assert (np.linalg.norm(poses[a, :3, 3] - poses[b, :3, 3], axis=1) <= _REACH_M).all()
    assert within_vio_limits(pairs, session, poses, _REACH_M, _ANGLE_DEG).all()
    assert len(pairs) <= _PER_FRAME * frames


def test_frames_without_vio_get_no_vio_pairs_and_no_limits() -> None:
    session, poses = _walk(40, 2)
    poses[10] = np.nan
    assert 10 not in _vio_pairs(session, poses)
    assert within_vio_limits(np.array([[0, 10], [10, 39]]), session, poses, _REACH_M, _ANGLE_DEG).all()


def test_sequence_pairs_are_the_next_frames_by_time_in_each_recording() -> None:
    recording = np.array(["a", "b", "a", "a", "b", "a"])
    t_ns = np.array([30, 5, 10, 20, 1, 40])
    pairs = sequence_pairs(recording, t_ns, [1, 2])
    assert pairs.tolist() == [[0, 2], [0, 3], [0, 5], [1, 4], [2, 3], [3, 5]]
    assert len(sequence_pairs(["a"], [0], [1, 2, 3])) == 0


def test_overlap_is_whole_for_equal_views_and_none_back_to_back() -> None:
    around = yaw_rotation([0, 0, np.pi, 0.3])
    poses = make_pose(around, np.zeros((4, 3)))
    intrinsics, size = np.tile([500.0, 500.0, 320.0, 240.0], (4, 1)), np.tile([640.0, 480.0], (4, 1))
    same, back, turned = view_overlap(np.array([[0, 1], [0, 2], [0, 3]]), poses, intrinsics, size, _REACH_M)
    assert same == 1
    assert back == 0
    assert 0.1 < turned < 0.9


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), per_frame=st.integers(1, 5))
def test_strongest_pairs_keep_the_best_of_each_frame(seed: int, per_frame: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = unique_pairs(rng.integers(0, 20, (60, 2)))
    score = rng.normal(size=len(pairs))
    kept = strongest_pairs(pairs, score, per_frame)
    _assert_canonical(kept)
    assert len(kept) <= per_frame * 20
    for frame in np.unique(pairs):
        mine = (pairs == frame).any(axis=1)
        best = pairs[mine][np.argmax(score[mine])]
        assert (kept == best).all(axis=1).any()


def test_transitive_pairs_close_chains_of_verified_pairs_alone() -> None:
    pairs = np.array([[0, 1], [1, 2], [2, 3], [4, 5]])
    found, strength = transitive_pairs(pairs, [100, 50, 0, 80], 6)
    assert found.tolist() == [[0, 2]]
    assert strength == pytest.approx([np.sqrt(100 * 50)])


def test_a_pair_keeps_the_first_origin_that_proposed_it() -> None:
    pairs, origin = first_origins(
        [
            (PairOrigin.SEQUENCE, np.array([[0, 1], [1, 2]])),
            (PairOrigin.VIO, np.array([[0, 2], [1, 2]])),
            (PairOrigin.RETRIEVAL, unique_pairs([])),
        ],
        3,
    )
    assert pairs.tolist() == [[0, 1], [0, 2], [1, 2]]
    assert origin.tolist() == ["sequence", "vio", "sequence"]
