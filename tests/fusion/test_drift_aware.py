"""The filter: its invariances, what it does with bad odometry and bad predictions, and whether it knows its errors."""

import json

import numpy as np
import pytest
from random_walks import random_walk
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from upright_walks import upright_walk

from fusion.drift_aware import DriftAware, DriftAwareOptions
from fusion.mobilearloc import MobileARLoc
from geometry.metrics import position_error, rotation_error_deg
from geometry.poses import make_pose, yaw_rotation


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


def test_hopeless_walks_and_switched_off_ingredients_run():
    switched_off = DriftAwareOptions(bias=False, local_scale=False, tilt=False, height=False, distrust=[1.0])
    for seed in range(6):
        walk = random_walk(seed)
        for options in (DriftAwareOptions(), switched_off):
            for estimate in answers(DriftAware(options), walk.t_ns, walk.vio, walk.apr):
                assert estimate.map_T_cam is None or np.isfinite(estimate.map_T_cam).all()
