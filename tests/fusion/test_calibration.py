"""Bounds that follow how far off earlier answers turned out to have been."""

import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.fusion.methods.drift_aware import DriftAware
from groundwalk.fusion.methods.estimator import calibration
from groundwalk.fusion.methods.estimator.calibration import Calibration
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.scoring.errors import within_bounds
from tests.fusion.upright_walks import upright_walk

BOUND = np.diag([0.04, 0.01, 0.04, 0.0001])


def judged(by: Calibration, sizes: float, frames: int = 3000) -> None:
    """Answers a second apart, whose errors seen later are `sizes` of what their bounds say."""
    rng = np.random.default_rng(0)
    for second in range(frames):
        for _, _, state, bound in by.due(float(second)):
            by.compare(state, bound, state + sizes * rng.normal(size=4) * np.sqrt(BOUND.diagonal()))
        by.remember((float(second), np.zeros(3), np.full(4, float(second)), BOUND))


@pytest.mark.parametrize("sizes", [0.1, 1.0, 3.0])
def test_covariances_grow_and_shrink_with_errors_that_are_seen_later(sizes: float) -> None:
    by = Calibration()
    assert np.allclose(by.inflation.diagonal(), [1, 1, 1, 0.8])
    judged(by, sizes)
    assert np.allclose(by.inflation.diagonal(), sizes**2 * np.array([5, 5, 5, 1.6]), rtol=0.25)


def test_answers_are_judged_once_when_they_are_old_enough_and_few_are_remembered() -> None:
    by, judged_at = Calibration(), []
    for frame in range(3000):
        judged_at += [(time_s, frame / 30) for time_s, *_ in by.due(frame / 30)]
        by.remember((frame / 30, np.zeros(3), np.zeros(4), BOUND))
    assert len(pickle.dumps(by)) < 20_000
    ages = np.array([at - past for past, at in judged_at])
    assert ages.min() >= 15 - 1e-9 and ages.max() < 15.1
    assert len({past for past, _ in judged_at}) == len(judged_at)


def test_one_wild_answer_is_not_the_rule() -> None:
    by = Calibration()
    judged(by, 1.0)
    before = by.inflation[0, 0]
    by.compare(np.zeros(4), BOUND, np.full(4, 1e6))
    assert before < by.inflation[0, 0] < 1.3 * before


def inside(alike_s: float) -> Array:
    """Share of positions and rotations within 95 % bounds, (2,), where predictions are wrong alike for so long."""
    within = []
    for seed in range(4):
        t_ns, truth, vio, _ = upright_walk(seed, frames=300)
        rng, error = np.random.default_rng(100 + seed), np.zeros((len(t_ns), 6))
        kept = np.exp(-1 / alike_s)
        for i in range(len(t_ns)):
            error[i] = kept * error[i - 1] + np.sqrt(1 - kept**2) * rng.normal(size=6)
        turn = Rotation.from_rotvec(np.radians(3.0) * error[:, 3:]).as_matrix()
        apr = make_pose(turn @ truth[:, :3, :3], truth[:, :3, 3] + 0.5 * error[:, :3])
        localiser = DriftAware()
        answers = [localiser.step(int(t), v, a) for t, v, a in zip(t_ns, vio, apr, strict=True)]
        fused, covariance = np.array([a.map_T_cam for a in answers]), np.array([a.covariance for a in answers])
        within.append(within_bounds(fused, truth, covariance))
    return np.asarray(np.mean(np.concatenate(within), axis=0))


def test_bounds_hold_however_long_predictions_are_wrong_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    for alike_s in (1.0, 10.0):  # 0.97, 0.91 of the positions
        assert (inside(alike_s) >= 0.85).all()
    with monkeypatch.context() as never:
        never.setattr(calibration, "_AGE_S", 1e9)
        assert inside(5.0)[0] < 0.7  # 0.60
