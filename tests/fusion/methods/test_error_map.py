"""What held-out frames tell of a regressor: against errors that are made by a known rule."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundwalk.fusion.methods.error_map import LEAST_FRAMES, ErrorMap, Expected, errors_of
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from tests.known import there


def walk(seed: int, frames: int = 150, noise: float = 0.1) -> tuple[Array, Array]:
    """True poses on a course of 30 m, and predictions: wrong by a smooth function of the place, five times as much in
    the half with x > 0, and by noise."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0, 2 * np.pi, frames, endpoint=False) + rng.uniform(0, 1)
    xyz = np.stack([8 * np.cos(along), rng.normal(1.5, 0.02, frames), 6 * np.sin(along)], axis=1)
    xyz += rng.normal(0, 0.2, (frames, 3)) * [1, 0, 1]
    true = make_pose(yaw_rotation(-along + rng.normal(0, 0.1, frames)), xyz)
    phase = along[:, None] * 3 + np.arange(4)
    size = np.where(np.cos(along) > 0, 1.0, 0.2)[:, None]
    error = size * (np.sin(phase) + noise * rng.normal(size=(frames, 4)))
    wrong = yaw_rotation(np.radians(5) * error[:, 0])
    lean = Rotation.from_rotvec(np.radians(2) * size * rng.normal(size=(frames, 3)) * [1, 0, 1]).as_matrix()
    return true, make_pose(wrong @ lean @ true[:, :3, :3], xyz + error[:, 1:] * [1, 0.3, 1])


def in_turns(count: int) -> NDArray[np.intp]:
    """Three frames are of one walk, the next three of another, and so on."""
    return np.arange(count) // 3 % 2


def from_all(apr: Array, true: Array) -> ErrorMap:
    return there(ErrorMap.learnt(apr, true, in_turns(len(apr))))


def asked(error_map: ErrorMap, apr: Array) -> list[Expected]:
    return [error_map.expected(p[:3, 3], p[:3, 2]) for p in apr]


@pytest.fixture(scope="module")
def learnt() -> ErrorMap:
    true, apr = walk(0)
    return from_all(apr, true)


def test_errors_come_apart_into_yaw_position_and_tilt() -> None:
    true = make_pose(Rotation.random(20, rng=0).as_matrix(), np.random.default_rng(0).normal(size=(20, 3)))
    yaw, shift = np.linspace(-2, 2, 20), np.array([1.0, -2.0, 3.0])
    error, tilt = errors_of(make_pose(yaw_rotation(yaw) @ true[:, :3, :3], true[:, :3, 3] + shift), true)
    assert error[:, 0] == pytest.approx(yaw) and error[:, 1:] == pytest.approx(np.tile(shift, (20, 1)))
    assert tilt == pytest.approx(0, abs=1e-6)
    lean = Rotation.from_rotvec([0.1, 0, 0]).as_matrix()
    assert errors_of(make_pose(lean @ true[:, :3, :3], true[:, :3, 3]), true)[1] == pytest.approx(0.1)


def test_another_walks_errors_are_expected_and_so_is_what_is_left(learnt: ErrorMap) -> None:
    true, apr = walk(1)
    error, tilt = errors_of(apr, true)
    expected = asked(learnt, apr)
    left = error - [e.error for e in expected]
    assert (np.abs(left).mean(axis=0) < 0.5 * np.abs(error).mean(axis=0)).all()
    square = left**2 / [e.shared + e.noise for e in expected]
    assert 0.85 < (square < chi2.ppf(0.95, 1)).mean() < 0.995
    hard = true[:, 0, 3] > 2
    easy = true[:, 0, 3] < -2
    sizes = np.array([e.shared + e.noise for e in expected])
    assert (np.median(sizes[hard], axis=0) > 4 * np.median(sizes[easy], axis=0)).all()
    leans = np.array([e.tilt for e in expected])
    assert np.median(leans[hard]) > 4 * np.median(leans[easy]) and 0.3 < np.mean(tilt**2 / 2 / leans) < 3


def beside(true: Array, seed: int, deg_per_m: float) -> tuple[Array, Array, Array]:
    """Predictions 0.3 m off to either side, turned left by so much a metre to the left, and a bit of noise on both."""
    rng = np.random.default_rng(seed)
    off = rng.normal(0, 0.3, len(true))
    yaw = np.radians(deg_per_m * off + rng.normal(0, 1.0, len(true)))
    across = np.cross(true[:, :3, 2], [0.0, -1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    shift = off[:, None] * across + rng.normal(0, 0.05, (len(true), 3))
    return make_pose(yaw_rotation(yaw) @ true[:, :3, :3], true[:, :3, 3] + shift), off, across


def test_yaw_that_comes_with_an_error_to_the_side_is_told() -> None:
    true, _ = walk(3)
    apr, _, across = beside(true, 0, 12.0)
    told = from_all(apr, true)
    assert np.degrees(told.reach.yaw_per_m) == pytest.approx(12, rel=0.15)
    for i in range(0, len(true), 10):
        expected = told.expected(apr[i, :3, 3], apr[i, :3, 2])
        # A metre along `across` comes with 12 deg, one along the viewing direction with none.
        along = across[i, ::2] @ expected.yaw_per_m
        assert np.degrees(along) == pytest.approx(12, rel=0.2)
        assert np.degrees(true[i, [0, 2], 2] @ expected.yaw_per_m) == pytest.approx(0, abs=2)


def test_yaw_errors_of_their_own_are_left_alone() -> None:
    slopes = []
    for seed in range(8):
        true, _ = walk(seed)
        slopes.append(from_all(beside(true, seed, 0.0)[0], true).reach.yaw_per_m)
    assert np.count_nonzero(slopes) <= 3 and np.abs(np.degrees(slopes)).max() < 1.5


def test_what_isnt_the_same_on_another_walk_is_no_expected_error() -> None:
    """Of walks with alike errors, with errors of their own, and of a single one, which can't tell."""
    walks = [walk(seed, 60) for seed in range(4)]
    alike = [np.concatenate(part) for part in zip(*walks, strict=True)]
    true, apr = alike[0], alike[1].copy()
    turned = yaw_rotation(np.repeat(np.radians([0, 90, 180, 270]), 60))
    apr[:, :3, 3] = true[:, :3, 3] + (turned @ (apr - true)[:, :3, 3, None])[:, :, 0]
    number = np.repeat(np.arange(4), 60)
    learnt = [there(ErrorMap.learnt(*of)) for of in ((alike[1], true, number), (apr, true, number))]
    assert learnt[0].reach.position_repeatability > 0.9 and learnt[0].reach.yaw_repeatability > 0.9
    assert learnt[1].reach.position_repeatability < 0.3
    single = there(ErrorMap.learnt(alike[1], true, np.zeros(240)))
    assert single.reach.position_repeatability == single.reach.yaw_repeatability == 0
    at, look = alike[1][200, :3, 3], alike[1][200, :3, 2]
    same, own = learnt[0].expected(at, look), single.expected(at, look)
    assert not own.error.any() and np.abs(same.error).max() > 0.05
    assert (own.shared > same.shared).all()  # what isn't corrected is left


def test_where_nothing_was_held_out_nothing_is_known(learnt: ErrorMap) -> None:
    far = learnt.expected(np.array([500.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    assert far.error == pytest.approx(0) and (far.shared > 0).all()
    _, apr = walk(1)
    near = np.median([e.shared for e in asked(learnt, apr)], axis=0)
    assert (far.shared > near).all()


def test_moving_the_map_moves_nothing() -> None:
    (true, apr), shift = walk(0), make_pose(np.eye(3), [40.0, -3.0, 90.0])
    here, moved = from_all(apr, true), from_all(shift @ apr, shift @ true)
    _, queries = walk(1)
    for a, b in zip(asked(here, queries[::20]), asked(moved, shift @ queries[::20]), strict=True):
        assert a.error == pytest.approx(b.error, abs=1e-3) and a.shared == pytest.approx(b.shared, rel=1e-2)


def test_a_table_gives_the_same_map(learnt: ErrorMap, tmp_path: Path) -> None:
    learnt.table().assign(scene="Place", model="PN").to_parquet(tmp_path / "map.parquet")
    again = ErrorMap.from_table(pd.read_parquet(tmp_path / "map.parquet"))
    _, apr = walk(2)
    for a, b in zip(asked(learnt, apr), asked(again, apr), strict=True):
        assert all(np.allclose(np.asarray(x), np.asarray(y), rtol=1e-9) for x, y in zip(a, b, strict=True))


def test_too_few_frames_make_no_map_and_missing_ones_do_not_count() -> None:
    true, apr = walk(0)
    apr[LEAST_FRAMES - 1 :] = np.nan
    assert ErrorMap.learnt(apr, true, np.zeros(len(apr))) is None
    true, apr = walk(0)
    apr[::7], true[3] = np.nan, np.nan
    known = np.isfinite(apr).all(axis=(1, 2)) & np.isfinite(true).all(axis=(1, 2))
    with_holes, without = from_all(apr, true), ErrorMap.learnt(apr[known], true[known], in_turns(150)[known])
    _, queries = walk(1, 20)
    for a, b in zip(asked(with_holes, queries), asked(there(without), queries), strict=True):
        assert np.array_equal(a.error, b.error)
