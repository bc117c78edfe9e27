"""Bounds that follow how far off earlier answers turned out to have been."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from upright_walks import upright_walk

from groundwalk.fusion.methods.drift_aware import DriftAware
from groundwalk.fusion.methods.drift_aware_options import DriftAwareOptions
from groundwalk.fusion.methods.estimator.hindsight import Answered, Hindsight
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.scoring.errors import within_bounds

BOUND = np.diag([0.04, 0.01, 0.04, 0.0001])


def hindsight() -> Hindsight:
    return Hindsight(20.0, np.array([1.0, 0.5]), 3.0, np.array([4.0, 2.0]))


def judged(by: Hindsight, sizes: float, frames: int = 400) -> None:
    """Answers a second apart, whose errors seen later are `sizes` of what their bounds say."""
    rng = np.random.default_rng(0)
    for second in range(frames):
        for answered in by.old(float(second)):
            by.judge(answered, answered.state + sizes * rng.normal(size=4) * np.sqrt(BOUND.diagonal()))
        by.remember(Answered(float(second), np.zeros(3), np.full(4, float(second)), BOUND))


@pytest.mark.parametrize("sizes", [0.1, 1.0, 3.0])
def test_covariances_grow_and_shrink_with_errors_that_are_seen_later(sizes: float) -> None:
    by = hindsight()
    assert np.allclose(by.widening.diagonal(), [1, 1, 1, 0.5])
    judged(by, sizes)
    assert np.allclose(by.widening.diagonal(), sizes**2 * np.array([4, 4, 4, 2]), rtol=0.25)


def test_answers_are_judged_once_when_they_are_old_enough_and_few_are_remembered() -> None:
    by, judged_at = hindsight(), []
    for frame in range(3000):
        judged_at += [(a.time_s, frame / 30) for a in by.old(frame / 30)]
        by.remember(Answered(frame / 30, np.zeros(3), np.zeros(4), BOUND))
    assert len(json.dumps(by.save())) < 10_000
    ages = np.array([at - answered for answered, at in judged_at])
    assert ages.min() >= 20 - 1e-9 and ages.max() < 20.1
    assert len({answered for answered, _ in judged_at}) == len(judged_at)


def test_a_saved_state_goes_on_alike_and_one_wild_answer_is_not_the_rule() -> None:
    by, again = hindsight(), hindsight()
    judged(by, 1.0)
    again.restore(json.loads(json.dumps(by.save())))
    assert np.array_equal(by.widening, again.widening)
    before = again.widening[0, 0]
    again.judge(Answered(0.0, np.zeros(3), np.zeros(4), BOUND), np.full(4, 1e6))
    assert before < again.widening[0, 0] < 1.3 * before


def inside(alike_s: float, options: DriftAwareOptions) -> Array:
    """Share of positions and rotations within 95 % bounds, (2,), where predictions are wrong alike for so long."""
    within = []
    for seed in range(8):
        t_ns, truth, vio, _ = upright_walk(seed, frames=300)
        rng, error = np.random.default_rng(100 + seed), np.zeros((len(t_ns), 6))
        kept = np.exp(-1 / alike_s)
        for i in range(len(t_ns)):
            error[i] = kept * error[i - 1] + np.sqrt(1 - kept**2) * rng.normal(size=6)
        turn = Rotation.from_rotvec(np.radians(3.0) * error[:, 3:]).as_matrix()
        apr = make_pose(turn @ truth[:, :3, :3], truth[:, :3, 3] + 0.5 * error[:, :3])
        localiser = DriftAware(options)
        answers = [localiser.step(int(t), v, a) for t, v, a in zip(t_ns, vio, apr, strict=True)]
        fused, covariance = np.array([a.map_T_cam for a in answers]), np.array([a.covariance for a in answers])
        within.append(within_bounds(fused, truth, covariance))
    return np.asarray(np.mean(np.concatenate(within), axis=0))


def test_bounds_hold_however_long_predictions_are_wrong_alike() -> None:
    for alike_s in (1.0, 5.0, 10.0):  # 0.97, 0.94, 0.91 of the positions
        assert (inside(alike_s, DriftAwareOptions()) >= 0.85).all()
    assert inside(5.0, DriftAwareOptions(hindsight_s=1e9))[0] < 0.7  # 0.60
