"""Rates of a camera against motions whose rates are known."""

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.poses import Array, make_pose
from geometry.rates import rates_at

_STEP_NS = 100_000_000


def _turning(t_s: Array) -> Array:
    """A camera that turns ever faster about its own axis and speeds up along x, (N, 4, 4)."""
    angle = 0.3 * t_s + 0.2 * t_s**2
    rotation = Rotation.from_rotvec(np.outer(angle, [0.0, 0.6, 0.8])).as_matrix()
    return make_pose(rotation, np.stack([0.5 * t_s**2, 0 * t_s, t_s], axis=1))


def test_rates_are_those_of_a_motion_with_constant_acceleration() -> None:
    log_ns = np.arange(20) * _STEP_NS
    t_ns = np.array([450_000_000, 700_000_000, 1_234_000_000])
    t_s = t_ns * 1e-9
    poses = _turning(t_s)
    rates = rates_at(t_ns, poses, log_ns, _turning(log_ns * 1e-9), 0.3)
    assert np.allclose(rates.angular, np.outer(0.3 + 0.4 * t_s, [0.0, 0.6, 0.8]), atol=1e-9)
    velocity = np.stack([t_s, 0 * t_s, np.ones_like(t_s)], axis=1)
    assert np.allclose(rates.velocity, np.einsum("nji,nj->ni", poses[:, :3, :3], velocity), atol=1e-9)


def test_change_says_how_much_the_rate_changes_around_the_moment() -> None:
    log_ns = np.arange(20) * _STEP_NS
    t_ns = log_ns[5:6]
    rates = rates_at(t_ns, _turning(t_ns * 1e-9), log_ns, _turning(log_ns * 1e-9), 0.3)
    # From the middle of the step before to the middle of the step after lie 0.1 s.
    assert np.allclose(rates.angular_change, [[0.0, 0.6 * 0.04, 0.8 * 0.04]], atol=1e-9)


def test_rates_at_the_ends_come_from_one_side_and_there_are_none_in_gaps() -> None:
    log_ns = np.array([0, 1, 2, 12, 13, 14]) * _STEP_NS
    t_ns = np.array([0, 1, 7, 13, 14]) * _STEP_NS
    rates = rates_at(t_ns, _turning(t_ns * 1e-9), log_ns, _turning(log_ns * 1e-9), 0.3)
    assert np.isfinite(rates.angular[:, 0]).tolist() == [True, True, False, True, True]
    assert np.isfinite(rates.angular_change[:, 0]).tolist() == [False, True, False, True, False]
    # From 0 to 0.1 s the camera turns by 0.032 rad.
    assert np.allclose(rates.angular[0], [0.0, 0.6 * 0.32, 0.8 * 0.32], atol=1e-9)
