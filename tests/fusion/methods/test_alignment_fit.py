"""The pieces of `drift_aware`'s fit, each alone, and the whole beside its slow, literal definition."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from groundwalk.fusion.methods.estimator.chain import Chain, apply, covariances_with, solve, write_error
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.fusion.methods.estimator.odometry_quality import OdometryQuality
from groundwalk.fusion.methods.estimator.prediction_errors import shrinkage_of, shrunk
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, yaw_rotation


def test_a_covariance_is_shrunk_as_far_as_it_is_large_beside_odometrys_drift() -> None:
    root = np.random.default_rng(4).normal(size=(6, 6))
    stated, drift = root @ root.T, np.array([2.0, 1.0, 3.0])
    assert shrinkage_of(1e-6 * stated, drift) < 1e-5 and shrinkage_of(stated, 1e-6 * drift) > 1 - 1e-4
    # Half where the variance is that of ten such ways.
    assert np.isclose(shrinkage_of(stated, np.full(3, stated.diagonal()[3:].mean() / 10)), 0.5)
    assert np.allclose(shrunk(stated, 0.0), stated)
    sizes = shrunk(stated, 1.0)
    assert np.allclose(sizes[:3, :3], stated[:3, :3]) and not sizes[:3, 3:].any() and not sizes[3:, :3].any()
    assert np.allclose(sizes[3:, 3:], stated.diagonal()[3:].mean() * np.eye(3))
    between = shrunk(stated, 0.5)
    assert np.allclose(between, (stated + sizes) / 2) and np.linalg.eigvalsh(between).min() > 0


def test_a_way_over_dropped_keyframes_is_as_uncertain_as_the_whole_of_it() -> None:
    table, yaw = Keyframes(10), 1e-4  # a metre's variance of yaw
    for i in range(100):
        aside = yaw / 6  # half of what a metre with this drift of yaw ends aside
        table.add(along=float(i), step=[0, 0, 1.0], drift=[aside, 0, aside, yaw], vio=[0, 0, i], time_s=float(i))
    metres = np.diff(table.rows["along"])
    assert metres.max() > 10
    assert np.allclose(table.rows["drift"][1:, 3], yaw * metres)
    assert np.allclose(table.rows["drift"][1:, [0, 2]].T, yaw * metres**3 / 6)


def chain(seed: int, count: int = 12) -> tuple[Chain, Array, Array]:
    """Odometry, states (N, 4), and predicted states (N, 4)."""
    rng = np.random.default_rng(seed)
    step = rng.normal(0, 1, (count, 3))
    precision = rng.uniform(1, 50, (count, 4))
    precision[:, 2] = precision[:, 0]
    position, yaw = np.cumsum(rng.normal(0, 1, (count, 3)), axis=0), rng.normal(0, 0.3, count)
    measured = np.column_stack([position + rng.normal(0, 0.5, (count, 3)), yaw + rng.normal(0, 0.2, count)])
    turn = rng.normal(0, 0.2, count)
    return Chain(step, turn, precision), np.column_stack([position, yaw]), measured


@pytest.mark.parametrize("seed", range(3))
def test_iterated_steps_reach_the_least_squares_of_scipy(seed: int) -> None:
    terms, state, measured = chain(seed)
    information = np.tile(np.diag([2.0, 3.0, 2.0, 5.0]), (len(state), 1, 1))

    def residuals(flat: Array) -> Array:
        p, t = flat.reshape(-1, 4)[:, :3], flat.reshape(-1, 4)[:, 3]
        found = [np.sqrt([2.0, 3.0, 2.0, 5.0]) * (measured - np.column_stack([p, t]))]
        for i in range(1, len(t)):
            e = yaw_rotation(-t[i - 1]) @ (p[i] - p[i - 1]) - terms.step[i]
            found.append(np.sqrt(terms.precision[i]) * [*e, t[i] - t[i - 1] - terms.turn[i]])
        return np.concatenate([np.ravel(f) for f in found])

    best = least_squares(residuals, state.ravel(), xtol=1e-12, ftol=1e-14).x.reshape(-1, 4)
    error = np.empty((len(state), 6))
    for _ in range(60):
        for i in range(len(state)):
            write_error(state[i], np.append(measured[i], [0.0, 0.0]), error[i])
        gradient = np.einsum("nij,nj->ni", information, error[:, [3, 4, 5, 1]])
        apply(state, solve(terms, state, information, gradient).increments)
    assert np.allclose(state, best, atol=1e-5)


def test_covariances_are_those_of_the_normal_equations_and_bind_all_keyframes() -> None:
    """Column by column, by increments that a unit gradient gives."""
    terms, state, _ = chain(4)
    count = len(state)
    information = np.tile(np.eye(4), (count, 1, 1))
    # A chain that is where odometry says: there the increments are the inverse times the gradient.
    for i in range(1, count):
        turned = yaw_rotation(state[i - 1, 3]) @ terms.step[i]
        state[i] = [*(state[i - 1, :3] + turned), state[i - 1, 3] + terms.turn[i]]
    inverse = np.empty((count, 4, count, 4))
    for i, axis in np.ndindex(count, 4):
        unit = np.zeros((count, 4))
        unit[i, axis] = 1.0
        found = solve(terms, state, information, unit)
        inverse[:, :, i, axis] = found.increments
    for at in (0, 5, count - 1):
        assert np.allclose(found.covariance[at], inverse[at, :, at])
        assert np.allclose(covariances_with(found, at), inverse[:, :, at])


def test_what_nothing_binds_is_an_error() -> None:
    terms, state, _ = chain(5)
    terms.precision[6] = 0
    information = np.zeros((len(state), 4, 4))
    information[0] = np.eye(4)
    with pytest.raises(GeometryError, match="undetermined"):
        solve(terms, state, information, np.zeros((len(state), 4)))


def judged(vio: Array, measured: Array, size: float = 0.25) -> Array:
    """Factors of drift after predictions (N, 3) beside odometry (N, 3)."""
    quality = OdometryQuality(1e-5)
    for i in range(len(vio)):
        way = vio[i] - vio[i - 1] if i else np.zeros(3)
        drift = np.array([1e-3, 1e-3, 1e-3, 1e-5])
        step = way, float(np.linalg.norm(way))
        quality.update(np.append(measured[i], np.zeros(3)), (size, 1e-3), *step, drift, (0.0, 0.0), False)
    return quality.factors


def test_drift_is_told_from_predictions_that_are_wrong_alike() -> None:
    """Whatever size was expected of their errors."""
    rng = np.random.default_rng(6)
    vio = np.column_stack([2.0 * np.arange(90), np.zeros(90), np.zeros(90)])
    shared = np.zeros((90, 3))
    for i in range(1, 90):
        shared[i] = 0.6 * shared[i - 1] + rng.normal(0, 0.5, 3)
    drifted = np.cumsum(rng.normal(0, 1.0, (90, 3)), axis=0)
    for size in (0.01, 0.25, 10.0):
        assert judged(vio, vio + shared, size)[0] < 4
        assert judged(vio, vio + drifted, size)[0] > 50


def test_drift_of_height_is_told_by_itself_near_that_of_position() -> None:
    """Phones' heights drift little, but not on every phone."""
    rng = np.random.default_rng(7)
    vio = np.column_stack([2.0 * np.arange(90), np.zeros(90), np.zeros(90)])
    steps = rng.normal(0, [0.03, 1.0, 0.03], (90, 3))
    position, height, *_ = judged(vio, vio + np.cumsum(steps, axis=0) + rng.normal(0, 0.1, (90, 3)), 0.01)
    assert position < 4 and height > 50
    # With few predictions it's about as large as the position's.
    position, height, *_ = judged(vio[:6], vio[:6] + np.cumsum(rng.normal(0, [1, 0.01, 1], (6, 3)), axis=0), 0.01)
    assert 0.2 < height / position < 1
