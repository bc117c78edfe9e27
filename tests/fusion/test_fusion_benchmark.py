"""The benchmark's walks are what they say, and its comparisons are right where the answer is known."""

from pathlib import Path

import numpy as np
import pytest
from known import cell

from benchmarks.fusion_inputs import (
    BAD_ODOMETRY,
    KIDNAPPED,
    MEASURED,
    RECORDED,
    SIMULATED,
    Case,
    measured_tracks,
    recorded_case,
    recorded_tracks,
    simulated_case,
)
from benchmarks.fusion_scores import (
    OURS,
    RAW,
    RULE,
    Target,
    Variant,
    ablations,
    against,
    overview,
    ratio_intervals,
    recovery_table,
    score,
    target_table,
    worst,
)
from groundwalk.fusion.evaluation.leaderboard_report import markdown
from groundwalk.fusion.methods import resolve_options
from groundwalk.fusion.walk import known
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import position_error, relative_error, step_lengths

SCENE, MODEL = "Stairs", "PN"
METHODS = [Variant(name, name, resolve_options(name)) for name in (RAW, RULE, OURS)]


def case(kind: str) -> Case:
    return simulated_case(kind, SCENE, MODEL, [0])


@pytest.fixture(scope="module")
def plain() -> Case:
    return case(SIMULATED)


def test_the_same_seed_gives_the_same_walks(plain: Case) -> None:
    again = case(SIMULATED)
    for a, b in zip(plain.walks, again.walks, strict=True):
        assert np.array_equal(a.map_T_cam_apr, b.map_T_cam_apr) and np.array_equal(a.vio_T_cam, b.vio_T_cam)


def lean_deg(vio_T_cam: Array, map_T_cam: Array) -> Array:
    """By how much odometry's down (N,) is off."""
    return np.degrees(np.arccos(np.sum(vio_T_cam[:, 1, :3] * map_T_cam[:, 1, :3], axis=1).clip(-1, 1)))


@pytest.mark.parametrize("kind", [SIMULATED, *BAD_ODOMETRY, KIDNAPPED])
def test_however_bad_simulated_odometry_is_it_knows_where_down_is(kind: str) -> None:
    for walk in case(kind).walks:
        there = known(walk.vio_T_cam)
        assert lean_deg(walk.vio_T_cam[there], walk.map_T_cam[there]).max() < 0.5


def test_spoilt_odometry_is_spoilt_as_it_says(plain: Case) -> None:
    lengths = step_lengths(plain.walks[0].vio_T_cam)[0]
    assert step_lengths(case("scale 5 %").walks[0].vio_T_cam)[0] == pytest.approx(1.05 * lengths)
    noisy = step_lengths(case("noise 10 %").walks[0].vio_T_cam)[0]
    assert 0.02 < np.std(noisy / lengths) < 0.2
    jumps = np.concatenate([relative_error(w.vio_T_cam, w.map_T_cam)[0] for w in case("jumps").walks])
    assert jumps.max() > 1.0
    for kind, least in (("dropouts", 0.1), ("restarts", 0.01)):
        missing = np.concatenate([~known(w.vio_T_cam) for w in case(kind).walks])
        assert least < missing.mean() < 0.6
    better = [position_error(w.map_T_cam_apr, w.map_T_cam).mean() for w in case("better APR").walks]
    assert np.mean(better) < 0.1


def test_comparisons_and_recovery(plain: Case) -> None:
    kidnapped = case(KIDNAPPED)
    assert all(np.diff(w.t_ns).max() > 10e9 for w in kidnapped.walks)
    summary, sessions = score(plain, METHODS)
    ratios = against(summary, SIMULATED, RULE)
    assert ratios.loc[RULE].to_numpy() == pytest.approx(1.0)
    rows = overview(summary, SIMULATED)
    assert cell(rows, OURS, "coverage %") == 100 > cell(rows, RULE, "coverage %")
    assert rows.loc[OURS, "position /rule"] == pytest.approx(rows["position m"][OURS] / rows["position m"][RULE])
    intervals = ratio_intervals(sessions, SIMULATED)
    assert intervals.loc[RULE].to_numpy() == pytest.approx(1.0)
    for name, unit in (("position", "m"), ("rotation", "deg")):
        low, middle, high = (cell(intervals, OURS, f"{name} {part}") for part in ("from", "/rule", "to"))
        assert middle == pytest.approx(ratios.loc[OURS][f"{name}_mean_{unit}"].mean()) and low < middle < high
    assert set(worst(summary, [SIMULATED])["method"]) == {RULE, OURS}
    _, sessions = score(kidnapped, METHODS)
    recovery = recovery_table(sessions).set_index("method")
    assert recovery.loc[RAW, "never %"] == 0 and recovery.loc[OURS, "walks"] == 2


def test_ablations_leave_out_one_ingredient_each() -> None:
    options = resolve_options(OURS)
    variants = ablations(options)
    base = options.model_dump()
    for variant in variants:
        changed = [k for k, v in variant.options.model_dump().items() if v != base[k]]
        kernels = ["degrees_of_freedom", "position_degrees_of_freedom"]
        assert len(changed) == 1 or changed == kernels, variant.label
    assert len({v.label for v in variants}) == len(variants) >= 4


def test_targets_say_whether_they_are_reached() -> None:
    table = target_table([Target("a", "", 0.4, high=0.45), Target("b", "", 1.0, low=2.0), Target("c", "", 99, 90, 98)])
    assert list(table[""]) == ["ok", "short", "short"]
    assert list(table["wanted"]) == ["at most 0.45", "at least 2", "90 to 98"]
    assert markdown(table).splitlines()[2] == "| a |  | 0.4 | at most 0.45 | ok |"


@pytest.mark.slow
def test_recorded_walks_differ_from_their_truth_by_a_drift_of_the_fitted_size(shared_trajectories: Path) -> None:
    tracks = {t.name: t for t in recorded_tracks(shared_trajectories)}
    assert len(tracks) == 10
    for name, track in tracks.items():
        steps_m, _ = relative_error(track.vio_T_cam, track.map_T_cam)
        # The ARCore log has 13 s of a phone that hardly moves.
        assert ("arcore_logger" in name or np.median(steps_m) > 0.003) and np.median(steps_m) < 0.02, name
        assert (steps_m.max() > 1) == ("floor_2_straight" in name)
        assert lean_deg(track.vio_T_cam, track.map_T_cam).max() < 1, name
    measured = measured_tracks(shared_trajectories)
    assert len(measured) == 2
    for track in measured:
        assert position_error(track.map_T_cam, track.map_T_cam[:1]).max() < 10
        steps_m, steps_deg = relative_error(track.vio_T_cam, track.map_T_cam)
        assert np.median(steps_m) < 0.02 and np.median(steps_deg) < 0.5
    assert len(recorded_case(MEASURED, measured, SCENE, MODEL).walks) == 2
    drawn = recorded_case(RECORDED, list(tracks.values())[:1], SCENE, MODEL, range(2)).walks
    assert len({w.session_id for w in drawn}) == 2
    assert not np.array_equal(drawn[0].map_T_cam_apr, drawn[1].map_T_cam_apr)
