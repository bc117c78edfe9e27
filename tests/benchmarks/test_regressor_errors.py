"""The model of regressors' errors: what hangs on the place hangs on the place, and the published figures are met."""

import numpy as np
import pytest

from benchmarks.fusion_inputs import Track, predicted_walk
from benchmarks.regressor_errors.fit import REGRESSORS, Walks, published
from benchmarks.regressor_errors.model import AprModel, read_apr_models, simulate_apr
from benchmarks.regressor_errors.repeatability import repeatability
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.simulation.scenes import NAMES

MODEL = AprModel(
    position_m=0.5,
    rotation_deg=3.0,
    position_spread=0.8,
    rotation_spread=0.8,
    spread_correlation=0.5,
    position_noise=0.0,
    rotation_noise=0.0,
    bias_length_m=3.0,
    bias_length_deg=45.0,
    tail=3.0,
)


def straight(length_m: float, step_m: float, turn_deg: float = 0.0) -> np.ndarray:
    """Poses along x, level, looking along z and turned by turn_deg."""
    x = np.arange(0, length_m, step_m)
    look = yaw_rotation(np.radians(turn_deg)) @ np.diag([1.0, -1.0, -1.0])
    return make_pose(look, np.stack([x, np.full(len(x), 1.5), np.zeros(len(x))], axis=1))


def offsets(truth: Array, model: AprModel = MODEL, map_seed: int = 1, noise_seed: int = 2) -> Array:
    return simulate_apr(truth, model, map_seed, noise_seed)[:, :3, 3] - truth[:, :3, 3]


@pytest.mark.parametrize(("share", "least", "most"), [(1.0, 0.8, 1.2), (0.0, -0.3, 0.3)])
def test_repeatability_tells_the_scenes_errors_from_a_walks_own(share: float, least: float, most: float) -> None:
    repeatable = {"position_repeatability": share, "rotation_repeatability": share}
    model = AprModel(**MODEL.__dict__ | repeatable | {"position_noise": 0.1, "rotation_noise": 0.1})
    poses = straight(200, 1.5)
    t_ns = np.arange(len(poses)) * 10**9
    walks = [predicted_walk("", Track(f"{i}", t_ns, poses, poses), simulate_apr(poses, model, 1, i)) for i in range(4)]
    frames, position, yaw = repeatability(walks)
    assert frames == 4 * len(poses)
    assert least < position < most and least < yaw < most


def test_bias_is_the_places_own_as_far_as_it_is_repeatable() -> None:
    there = straight(30, 0.5)
    every = AprModel(**MODEL.__dict__ | {"position_repeatability": 1.0})
    assert np.allclose(offsets(there, every, noise_seed=2), offsets(there[::-1], every, noise_seed=3)[::-1])
    assert not np.allclose(offsets(there, every), offsets(there, every, map_seed=9))
    half = AprModel(**MODEL.__dict__ | {"position_repeatability": 0.5, "position_spread": 0.0})
    one, other = (
        np.concatenate([offsets(there, half, seed, noise_seed=seed + k) for seed in range(200)]) for k in (1000, 2000)
    )
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] == pytest.approx(0.5, abs=0.07)
    turned = straight(30, 0.5, 180)
    assert np.abs(offsets(there) - offsets(turned)).mean() > 0.1


def test_bias_changes_over_its_length() -> None:
    """Nearly the same a tenth of the length on, unrelated three lengths on."""
    e = np.concatenate([offsets(straight(200, 0.3), MODEL, seed)[:, [0, 2]] for seed in range(20)], axis=1)
    near, far = (np.corrcoef(e[:-k].ravel(), e[k:].ravel())[0, 1] for k in (1, 30))
    assert near > 0.95 and abs(far) < 0.25


def test_noise_is_new_in_each_frame_and_has_heavy_tails() -> None:
    model = AprModel(**MODEL.__dict__ | {"position_noise": 1.0, "position_spread": 0.0, "rotation_noise": 1.0})
    e = np.concatenate([offsets(straight(400, 0.3), model, 1, seed) for seed in range(10)])[:, 0]
    assert abs(np.corrcoef(e[:-1], e[1:])[0, 1]) < 0.1
    # Of a Gaussian 0.006 % of the values lie beyond four times the quartile's spread.
    spread = np.percentile(np.abs(e), 50) / 0.6745
    assert np.mean(np.abs(e) > 4 * spread) > 0.005


def test_amplitude_scales_both_errors() -> None:
    truth = straight(30, 0.5)
    full, tenth = (simulate_apr(truth, MODEL, 1, 2, a) for a in (1.0, 0.1))
    assert np.allclose(position_error(tenth, truth), 0.1 * position_error(full, truth))
    assert np.allclose(rotation_error_deg(tenth, truth), 0.1 * rotation_error_deg(full, truth))


def test_values_out_of_range_are_refused() -> None:
    with pytest.raises(GeometryError, match="position_noise"):
        AprModel(**MODEL.__dict__ | {"position_noise": 1.5})


@pytest.mark.slow
@pytest.mark.parametrize("scene", NAMES)
@pytest.mark.parametrize("regressor", REGRESSORS)
def test_committed_sizes_meet_the_published_rows(scene: str, regressor: str) -> None:
    target, found = published(scene, regressor), Walks(scene, regressor, 3).figures(read_apr_models()[scene, regressor])
    # Least well: mean rotation in Office, where a few frames are off by far more than the rest.
    assert found.every[:4] == pytest.approx(target.every[:4], rel=0.4)
    assert np.abs(found.every[4:] - target.every[4:]).max() < 10
    assert found.passing_pct == pytest.approx(target.passing_pct, abs=4)
