"""Scores of frame sets, and the bootstrap's figures of them: one definition, counted in two ways."""

import numpy as np
import pytest

from groundwalk.scoring.bootstrap import DRAWS, drawn_figures, draws, interval
from groundwalk.scoring.scores import score


def test_a_missing_pose_is_an_infinite_error() -> None:
    rare = score([0.1, 0.2, np.nan], [1.0, 1.0, np.nan])
    assert (rare.frames, rare.answered) == (3, 2) and rare.mean_m == pytest.approx(0.15) and rare.median_m == 0.2
    assert rare.high == pytest.approx(200 / 3)
    assert np.isnan(score([0.1, np.nan, np.nan], [1.0, np.nan, np.nan]).median_m)
    assert np.isnan(score([], []).mean_m)


def test_levels_are_over_certain_frames() -> None:
    of_all, of_certain = score([0.1, 9.0], [1.0, 1.0]), score([0.1, 9.0], [1.0, 1.0], np.array([True, False]))
    assert (of_all.high, of_certain.high) == (50, 100) and of_all.mean_m == of_certain.mean_m


def test_each_session_counted_once_gives_the_score() -> None:
    rng = np.random.default_rng(0)
    position, rotation = rng.exponential(0.4, 60), rng.exponential(4, 60)
    position[::7] = rotation[::7] = np.nan
    certain = rng.random(60) < 0.8
    weights = draws(3)[:, np.repeat(range(3), 20)]
    assert weights.shape == (1 + DRAWS, 60) and (draws(3).sum(axis=1) == 3).all()
    figures = dict(drawn_figures(position, rotation, certain, weights))
    expected = score(position, rotation, certain)
    assert figures["position_mean_m"][0] == pytest.approx(expected.mean_m)
    assert figures["rotation_median_deg"][0] == pytest.approx(expected.median_deg)
    assert figures["medium_pct"][0] == pytest.approx(expected.medium)
    low, high = interval(figures["position_mean_m"][1:])
    assert low is not None and high is not None and low < expected.mean_m < high
