"""The filter: its invariances, what it does with bad odometry and bad predictions, and whether it knows its errors."""

import json

import numpy as np
import pytest
from random_walks import random_walk
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from upright_walks import upright_walk

from groundwalk.fusion.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.error_map import ErrorMap
from groundwalk.fusion.mobilearloc import MobileARLoc
from groundwalk.geometry.poses import interpolate, make_pose, yaw_rotation
from groundwalk.scoring.errors import position_error, rotation_error_deg


def answers(localiser, t_ns, vio, apr):
    return [localiser.step(int(t), v, a) for t, v, a in zip(t_ns, vio, apr, strict=True)]


def poses(estimates):
    return np.array([e.map_T_cam for e in estimates])


def test_every_frame_has_an_answer_and_it_beats_the_rule_and_the_raw_predictions():
    ours, rule, raw = [], [], []
    for seed in range(5):
        t_ns, truth, vio, apr = upright_walk(seed)
        fused = poses(answers(DriftAware(), t_ns, vio, apr))
        ours.append((position_error(fused, truth).mean(), rotation_error_deg(fused, truth).mean()))
        raw.append((position_error(apr, truth).mean(), rotation_error_deg(apr, truth).mean()))
        answered = [(e.map_T_cam, p) for e, p in zip(answers(MobileARLoc(), t_ns, vio, apr), truth, strict=True)]
        kept, true = (np.array(x) for x in zip(*[pair for pair in answered if pair[0] is not None], strict=True))
        rule.append((position_error(kept, true).mean(), rotation_error_deg(kept, true).mean()))
    ours, rule, raw = (np.mean(x, axis=0) for x in (ours, rule, raw))
    assert (ours < 0.45 * rule).all() and (ours < 0.25 * raw).all()


def test_covariance_holds_the_errors():
    inside = []
    for seed in range(10, 18):
        t_ns, truth, vio, apr = upright_walk(seed)
        for estimate, pose in zip(answers(DriftAware(), t_ns, vio, apr), truth, strict=True):
            error = pose[:3, 3] - estimate.map_T_cam[:3, 3]
            covariance = estimate.covariance[3:, 3:]
            inside.append(error @ np.linalg.solve(covariance, error) <= chi2.ppf(0.95, 3))
            assert np.linalg.eigvalsh(estimate.covariance).min() > 0
    assert 0.9 <= np.mean(inside) <= 1.0


def test_going_on_from_a_saved_state_changes_nothing():
    t_ns, _, vio, apr = upright_walk(1, 60)
    whole, localiser = answers(DriftAware(), t_ns, vio, apr), DriftAware()
    sizes = []
    for i in range(60):
        text = json.dumps(localiser.save())
        sizes.append(len(text))
        localiser = DriftAware()
        localiser.restore(json.loads(text))
        assert np.array_equal(localiser.step(int(t_ns[i]), vio[i], apr[i]).map_T_cam, whole[i].map_T_cam)
    assert max(sizes[30:]) <= 1.05 * max(sizes[2:30])


def test_odometry_between_predictions_changes_little():
    """Ten odometry poses a second and one prediction: as good and as sure as at one pose a second."""
    found = {1: [], 10: []}
    for seed in range(4):
        t_ns, truth, vio, apr = upright_walk(seed, 100)
        for rate in found:
            fine_ns = np.arange(t_ns[0], t_ns[-1] + 1, 10**9 // rate)
            odometry = interpolate(t_ns, vio, fine_ns)
            given = [apr[i // rate] if i % rate == 0 else None for i in range(len(fine_ns))]
            estimates = answers(DriftAware(), fine_ns, odometry, given)
            assert all(e.map_T_cam is not None for e in estimates)
            error = position_error(poses(estimates[::rate]), truth).mean()
            # The last before a prediction has the largest covariance.
            found[rate].append((error, np.mean([e.signals["position_sd_m"] for e in estimates[rate - 1 :: rate]])))
    (error, sd), (fine_error, fine_sd) = (np.mean(found[rate], axis=0) for rate in (1, 10))
    assert fine_error < 1.1 * error and sd < 1.3 * fine_sd and fine_sd < 1.3 * sd


def test_frames_of_reference_do_not_matter():
    """Turning or moving odometry's frame moves nothing in the map; moving the map moves the answers with it."""
    t_ns, _, vio, apr = upright_walk(2, 80)
    other_T_vio = make_pose(yaw_rotation(1.1), [100.0, -3.0, 40.0])
    other_T_map = make_pose(yaw_rotation(-2.5), [-7.0, 2.0, 60.0])
    expected = poses(answers(DriftAware(), t_ns, vio, apr))
    assert np.allclose(poses(answers(DriftAware(), t_ns, other_T_vio @ vio, apr)), expected, atol=1e-6)
    # Horizontal axes share one scale, so that turning the map about the vertical is no change either.
    moved = poses(answers(DriftAware(), t_ns, vio, other_T_map @ apr))
    assert np.allclose(moved, other_T_map @ expected, atol=0.05)


@pytest.mark.parametrize("trouble", ["jump", "scale", "noise", "dropout"])
def test_bad_odometry_never_makes_it_worse_than_the_predictions(trouble):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        t_ns, truth, vio, apr = upright_walk(seed)
        vio = vio.copy()
        if trouble == "jump":
            vio[100:, :3, 3] += [4.0, 0.0, 3.0]
        elif trouble == "scale":
            vio[:, :3, 3] *= 1.05
        elif trouble == "noise":
            vio[:, :3, 3] += np.cumsum(rng.normal(0, 0.1, (200, 3)), axis=0)
        lost = set(range(100, 108)) if trouble == "dropout" else set()
        odometry = [None if i in lost else v for i, v in enumerate(vio)]
        estimates = answers(DriftAware(), t_ns, odometry, apr)
        if trouble == "jump":
            assert "odometry_jump" in estimates[100].reasons
        assert position_error(poses(estimates), truth).mean() < 0.6 * position_error(apr, truth).mean()


def test_a_bad_prediction_is_noticed_by_its_gravity():
    """A prediction that is 3 m off and tilted moves the answer less when its tilt is looked at."""
    moved, scale = {True: [], False: []}, {True: [], False: []}
    for seed in range(12):
        t_ns, _, vio, apr = upright_walk(seed, 4, outliers=0.0)
        bad = apr.copy()
        bad[-1, :3, 3] += [3.0, 0.0, 0.0]
        bad[-1, :3, :3] = Rotation.from_rotvec([np.radians(40), 0, 0]).as_matrix() @ bad[-1, :3, :3]
        for tilt in (True, False):
            options = DriftAwareOptions(tilt=tilt)
            fooled, fine = (answers(DriftAware(options), t_ns, vio, p)[-1] for p in (bad, apr))
            moved[tilt].append(np.linalg.norm(fooled.map_T_cam[:3, 3] - fine.map_T_cam[:3, 3]))
            scale[tilt].append(fooled.signals["local_scale"])
    assert np.mean(moved[True]) < 0.9 * np.mean(moved[False])
    assert np.mean(scale[True]) > 1.5 * np.mean(scale[False])


def test_one_prediction_far_off_does_not_silence_the_good_ones_after_it():
    """It is turned by 150 degrees and 12 m off; what it says of the place is forgotten soon."""
    after, at = [], []
    for seed in range(6):
        t_ns, _, vio, apr = upright_walk(seed, 40, outliers=0.0)
        bad = apr.copy()
        bad[20] = make_pose(yaw_rotation(2.6) @ bad[20, :3, :3], bad[20, :3, 3] + [12.0, 0.0, 0.0])
        fooled, fine = (answers(DriftAware(), t_ns, vio, p) for p in (bad, apr))
        at.append(fooled[20].signals["local_scale"] / fine[20].signals["local_scale"])
        # The prediction after it shows as large a change of the error; the one after that doesn't.
        after.append(fooled[22].signals["local_scale"] / fine[22].signals["local_scale"])
    assert np.mean(at) > 3 and np.mean(after) < 2


def test_some_seconds_of_wrong_predictions_are_no_reason_to_leave_odometry():
    """A look aside at what the regressor doesn't know: five predictions in a row at some other place."""
    strayed = {0.0: [], DriftAwareOptions().outlier_runs: []}
    for seed in range(5):
        rng = np.random.default_rng(seed)
        t_ns, truth, vio, apr = upright_walk(seed, 60, noise_m=0.3, outliers=0.0)
        shift, yaw = rng.uniform(-12, 12, 3) * [1, 0.05, 1], rng.uniform(1, 3)
        for i in range(40, 45):
            turned = yaw_rotation(yaw + rng.normal(0, 0.2)) @ apr[i, :3, :3]
            apr[i] = make_pose(turned, apr[i, :3, 3] + shift + rng.normal(0, 1, 3) * [1, 0.1, 1])
        for share, found in strayed.items():
            fused = poses(answers(DriftAware(DriftAwareOptions(outlier_runs=share)), t_ns, vio, apr))
            found.append(position_error(fused, truth)[40:45].max())
    alone, in_runs = (np.mean(found) for found in strayed.values())
    assert in_runs < 0.3 * alone and in_runs < 1.5


def test_a_long_row_of_alike_mistakes_is_told_from_lost_odometry_by_its_gravity():
    """Ten predictions wrong in the same way: where they lean, odometry is still believed at their end."""
    strayed = {0: [], 30: []}
    for seed in range(5):
        t_ns, truth, vio, apr = upright_walk(seed, 80, noise_m=0.3, outliers=0.0)
        for lean_deg, found in strayed.items():
            lean = Rotation.from_rotvec(np.radians([lean_deg, 0, 0])).as_matrix()
            wrong = apr.copy()
            wrong[40:50] = make_pose(lean @ yaw_rotation(1.0) @ apr[40:50, :3, :3], apr[40:50, :3, 3] + [4.0, 0, 2.0])
            fused = poses(answers(DriftAware(), t_ns, vio, wrong))
            found.append(position_error(fused, truth)[45:50].mean())
    upright, leaning = (np.mean(found) for found in strayed.values())
    assert leaning < 0.3 * upright and leaning < 1


def test_a_jump_too_short_to_see_is_answered_by_following_the_predictions():
    """2 m within a second could be a walk; the predictions say that it wasn't one."""
    after = {"tried": [], "believed": []}
    for seed in range(4):
        t_ns, truth, vio, apr = upright_walk(seed, noise_m=0.15, outliers=0.05)
        vio = vio.copy()
        vio[100:, :3, 3] += [1.5, 0.0, -1.3]
        for name, options in (
            ("tried", DriftAwareOptions()),
            ("believed", DriftAwareOptions(distrust=[1.0], lost=False)),
        ):
            estimates = answers(DriftAware(options), t_ns, vio, apr)
            assert not any("odometry_jump" in e.reasons for e in estimates)
            after[name].append(position_error(poses(estimates), truth)[110:130].mean())
    assert np.mean(after["tried"]) < 0.9 * np.mean(after["believed"])


def test_odometry_that_starts_anew_elsewhere_is_aligned_anew_and_one_that_comes_back_is_believed():
    again, back = [], []
    for seed in range(6):
        t_ns, truth, vio, apr = upright_walk(seed)
        other = vio.copy()
        other[105:] = make_pose(yaw_rotation(2.0), [3.0, 0.5, -9.0]) @ other[105:]
        gone = [[None if 100 <= i < 105 else v for i, v in enumerate(poses)] for poses in (other, vio)]
        anew, same = (poses(answers(DriftAware(), t_ns, odometry, apr)) for odometry in gone)
        again.append(rotation_error_deg(anew, truth)[108:].mean())
        back.append(rotation_error_deg(same, truth)[105:115].mean() / rotation_error_deg(apr, truth)[105:115].mean())
    assert np.mean(again) < 5 and np.mean(back) < 0.6


def test_what_was_learnt_beforehand_is_used_and_can_be_switched_off():
    """A regressor with the same bias along the same way, which held-out frames of another walk have shown."""
    ratio = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        t_ns, truth, vio, _ = upright_walk(seed)
        lean = np.sin(truth[:, :3, 3] @ rng.normal(0, 0.2, (3, 3)) + rng.uniform(0, 6, 3))
        bias = 1.5 * lean * [1.0, 0.2, 1.0]

        def predicted(rng=rng, truth=truth, bias=bias):
            shift = bias + rng.normal(0, 0.1, (200, 3))
            turn = Rotation.from_rotvec(np.radians(1) * rng.normal(size=(200, 3))).as_matrix()
            return make_pose(turn @ truth[:, :3, :3], truth[:, :3, 3] + shift)

        error_map = ErrorMap.learnt(predicted(), truth)
        apr = predicted()
        with_map, switched_off, without = (
            position_error(poses(answers(localiser, t_ns, vio, apr)), truth).mean()
            for localiser in (
                DriftAware(None, error_map),
                DriftAware(DriftAwareOptions(error_map=False), error_map),
                DriftAware(),
            )
        )
        assert switched_off == without
        ratio.append(with_map / without)
    assert np.mean(ratio) < 0.5


def test_a_regressor_that_takes_a_step_aside_for_a_turn_is_seen_through():
    """Held-out frames tell how much yaw comes with a metre aside, so that a yaw error shows in the position's."""
    with_it, without = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        t_ns, truth, vio, _ = upright_walk(seed)

        def predicted(rng=rng, truth=truth):
            aside = np.zeros(200)
            for i in range(1, 200):
                aside[i] = 0.8 * aside[i - 1] + 0.6 * 0.4 * rng.normal()
            turn = yaw_rotation(np.radians(15 * aside + rng.normal(size=200)))
            return make_pose(turn @ truth[:, :3, :3], truth[:, :3, 3] + aside[:, None] * truth[:, :3, 0])

        error_map = ErrorMap.learnt(predicted(), truth)
        apr = predicted()
        for found, options in ((with_it, None), (without, DriftAwareOptions(side_yaw=False))):
            fused = poses(answers(DriftAware(options, error_map), t_ns, vio, apr))
            found.append(rotation_error_deg(fused, truth).mean())
    assert np.mean(with_it) < 0.85 * np.mean(without)


def test_hopeless_walks_and_switched_off_ingredients_run():
    switched_off = DriftAwareOptions(
        bias=False, local_scale=False, tilt=False, height=False, distrust=[1.0], lost=False
    )
    for seed in range(6):
        walk = random_walk(seed)
        for options in (DriftAwareOptions(), switched_off):
            for estimate in answers(DriftAware(options), walk.t_ns, walk.vio, walk.apr):
                assert estimate.map_T_cam is None or np.isfinite(estimate.map_T_cam).all()
