"""Sessions joined by the points that they share."""

import numpy as np

from groundwalk.geometry.poses import Array, inverse, make_pose, transform, yaw_rotation
from groundwalk.sfm.mapping.from_vio import join_sessions

_POINTS = 60


def _sessions(rng: np.random.Generator) -> tuple[Array, dict[str, Array], np.ndarray, dict[str, np.ndarray]]:
    """Points by feature, where each session's VIO frame is, matches and rows of three sessions of two frames; all see
    the same points, but no match ties c to the others."""
    world = rng.uniform(-5, 5, (_POINTS, 3))
    world_T_vio = {
        s: make_pose(yaw_rotation(yaw), rng.uniform(-9, 9, 3)) for s, yaw in (("a", 0.0), ("b", 2.0), ("c", 1.0))
    }
    # Each frame has all points as features, in order.
    xyz = np.concatenate([transform(inverse(world_T_vio[s]), world) for s in "aabbcc"])
    rows = {"a": np.array([0, 1]), "b": np.array([2, 3]), "c": np.array([4, 5])}
    k = np.arange(_POINTS)
    matches = np.concatenate([np.stack([k, 2 * _POINTS + k], 1), np.stack([3 * _POINTS + k, _POINTS + k], 1)])
    return xyz, world_T_vio, matches, rows


def test_sessions_that_share_points_get_a_common_frame_in_spite_of_wrong_matches() -> None:
    rng = np.random.default_rng(1)
    xyz, world_T_vio, matches, rows = _sessions(rng)
    wrong = rng.permutation(len(matches))[: len(matches) // 3]
    matches[wrong, 1] = 2 * _POINTS + rng.integers(0, _POINTS, len(wrong))
    together, alone = join_sessions(xyz, matches, matches // _POINTS, rows, 0)
    assert (list(together), list(alone)) == (["a", "b"], ["c"])
    a_T_b = inverse(together["a"]) @ together["b"]
    assert np.abs(a_T_b - inverse(world_T_vio["a"]) @ world_T_vio["b"]).max() < 1e-6


def test_sessions_that_share_too_few_points_stay_apart() -> None:
    xyz, _, matches, rows = _sessions(np.random.default_rng(2))
    few = matches[:20]
    assert [list(group) for group in join_sessions(xyz, few, few // _POINTS, rows, 0)] == [["a"], ["b"], ["c"]]
