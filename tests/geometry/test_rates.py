"""Rates of a camera against motions whose rates are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose
from groundwalk.geometry.rates import rates_at

_STEP_NS = 100_000_000


def _turning(t_s: np.ndarray) -> Array:
    """A camera that turns ever faster about its own axis and speeds up along x, (N, 4, 4)."""
    angle = 0.3 * t_s + 0.2 * t_s**2
    rotation = Rotation.from_rotvec(np.outer(angle, [0.0, 0.6, 0.8])).as_matrix()
    return make_pose(rotation, np.stack([0.5 * t_s**2, 0 * t_s, t_s], axis=1))


def _sway(t_s: np.ndarray) -> tuple[Array, Array, Array]:
    """A camera that nods and sways at 2 Hz as it is carried: poses (N, 4, 4), angular velocity and velocity (N, 3)."""
    phase = 4 * np.pi * t_s
    rotation = Rotation.from_rotvec(np.outer(0.02 * np.sin(phase), [1.0, 0, 0])).as_matrix()
    poses = make_pose(rotation, np.outer(0.03 * np.cos(phase), [1.0, 0, 0]) + np.outer(t_s, [0, 0, 1.0]))
    angular = np.outer(0.02 * 4 * np.pi * np.cos(phase), [1.0, 0, 0])
    velocity = np.outer(-0.03 * 4 * np.pi * np.sin(phase), [1.0, 0, 0]) + np.array([0, 0, 1.0])
    return poses, angular, np.einsum("nji,nj->ni", rotation, velocity)


def test_rates_of_steps_are_not_smoothed_away() -> None:
    log_ns = np.arange(100) * _STEP_NS
    t_ns = log_ns[20:80]
    _, angular, velocity = _sway(t_ns * 1e-9)
    rates = rates_at(t_ns, log_ns, _sway(log_ns * 1e-9)[0], 0.3)
    slope = np.sum(rates.angular * angular) / np.sum(angular**2)
    assert slope == pytest.approx(1, abs=0.03)
    of_neighbours = rates.angular - rates.angular_difference
    assert np.sum(of_neighbours * angular) / np.sum(angular**2) < 0.8
    assert np.abs(rates.velocity - velocity).max() < 0.02


def test_difference_says_how_far_rates_may_be_off() -> None:
    log_ns, t_ns = np.arange(100) * _STEP_NS, np.arange(200, 800, dtype=np.int64) * (_STEP_NS // 10)
    rates = rates_at(t_ns, log_ns, _sway(log_ns * 1e-9)[0], 0.3)
    error = rates.angular - _sway(t_ns * 1e-9)[1]
    assert 0.2 < np.sqrt(np.mean(error**2)) / np.sqrt(np.mean((rates.angular_difference / 2) ** 2)) < 1


def test_there_are_no_rates_in_gaps_and_no_difference_at_the_ends() -> None:
    log_ns = np.array([0, 1, 2, 12, 13, 14, 30]) * _STEP_NS
    t_ns = np.array([0, 1, 7, 13, 14, 30, 31]) * _STEP_NS
    rates = rates_at(t_ns, log_ns, _turning(log_ns * 1e-9), 0.3)
    assert np.isfinite(rates.angular[:, 0]).tolist() == [True, True, False, True, True, False, False]
    assert np.isfinite(rates.angular_difference[:, 0]).tolist() == [False, True, False, True, False, False, False]
    # From 0 to 0.1 s the camera turns by 0.032 rad.
    assert np.allclose(rates.angular[0], [0.0, 0.6 * 0.32, 0.8 * 0.32], atol=0.02)


def test_a_jump_of_the_log_is_no_motion() -> None:
    log_ns = np.arange(20) * _STEP_NS
    poses = _turning(log_ns * 1e-9)
    expected = rates_at(log_ns, log_ns, poses, 0.3)
    jumped = poses.copy()
    jumped[10:, :3, 3] += [0.3, 0.0, 0.0]
    rates = rates_at(log_ns, log_ns, jumped, 0.3, log_ns[10:11])
    assert np.abs(rates.velocity - expected.velocity).max() < 0.01
    assert np.flatnonzero(np.isnan(rates.angular_difference[:, 0])).tolist() == [0, 9, 10, 19]
    assert np.isnan(rates_at(log_ns[9:10] + _STEP_NS // 2, log_ns, jumped, 0.3, log_ns[10:11]).velocity).all()
