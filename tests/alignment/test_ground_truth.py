"""The whole alignment on synthetic walks: what it recovers, what it doesn't depend on, and what it refuses."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.ground_truth import AlignResult
from groundwalk.alignment.settings import AlignSettings
from groundwalk.geometry.fits import Sim3, fit_sim3
from groundwalk.geometry.poses import make_pose
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import UserError
from groundwalk.store.choices import NotRegistered
from groundwalk.store.tables import poses_of
from tests.synthetic_walks import Scene, Walks, align

# About what phones do: a centimetre of model noise, VIO off by 0.3 % and 0.2 degrees a session, drifting meanwhile.
PHONES = {
    "sessions": 5,
    "sfm_m": 0.01,
    "sfm_deg": 0.05,
    "drift_m": 0.01,
    "drift_yaw_deg": 0.1,
    "jitter_m": 0.003,
    "phone_scale": 0.003,
    "phone_tilt_deg": 0.15,
}


def run(scene: Scene, **settings: Any) -> AlignResult:
    return align(scene.inputs(), AlignSettings(**settings))


def ground_truth(aligned: AlignResult) -> np.ndarray:
    return poses_of(aligned.ground_truth, "map_cam")


def against_truth(aligned: AlignResult, scene: Scene) -> tuple[Sim3, np.ndarray, np.ndarray]:
    """true_S_map, and the errors after it in metres and degrees of the frames with ground truth."""
    gt = ground_truth(aligned)
    known = np.isfinite(gt[:, 0, 0])
    true_S_map = fit_sim3(scene.true_T_cam[known, :3, 3], gt[known, :3, 3])
    moved = true_S_map.poses(gt[known])
    return (
        true_S_map,
        position_error(moved, scene.true_T_cam[known]),
        rotation_error_deg(moved, scene.true_T_cam[known]),
    )


def test_without_noise_the_truth_comes_back_exactly(walks: Walks) -> None:
    scene = walks.make()
    aligned = run(scene)
    true_S_map, metres, degrees = against_truth(aligned, scene)
    assert true_S_map.scale == pytest.approx(1, abs=1e-9)
    assert true_S_map.rotation[1, 1] == pytest.approx(1, abs=1e-9)
    assert metres.max() < 1e-9 and degrees.max() < 1e-6
    # Rule of the map's origin and heading: those of the first session's VIO frame.
    first = aligned.fits[0]
    np.testing.assert_allclose(first.map_T_vio, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(ground_truth(aligned)[:60], poses_of(scene.frames, "vio_cam")[:60], atol=1e-9)
    assert (aligned.checks["status"] == "passed").all()
    assert (aligned.ground_truth["quality"] == "A").all()


@pytest.mark.parametrize("seed", range(2))
def test_any_gauge_of_sfm_gives_the_same_ground_truth(walks: Walks, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = walks.make(**PHONES | {"seed": seed, "sessions": 2, "frames": 30})
    other = Sim3(float(np.exp(2 * rng.normal())), Rotation.random(rng=rng).as_matrix(), rng.normal(0, 20, 3))
    a, b = run(scene), run(scene.in_gauge(other))
    np.testing.assert_allclose(ground_truth(a), ground_truth(b), atol=1e-9)
    np.testing.assert_allclose(
        np.stack(list(a.ground_truth["covariance"])), np.stack(list(b.ground_truth["covariance"])), atol=1e-9
    )
    pd.testing.assert_frame_equal(a.checks, b.checks, rtol=1e-6, atol=1e-9)
    pd.testing.assert_frame_equal(a.sessions, b.sessions, rtol=1e-6, atol=1e-9)


def test_scale_and_vertical_come_from_all_sessions_together(walks: Walks) -> None:
    scenes = [walks.make(**PHONES | {"seed": seed}) for seed in range(2)]
    for scene in scenes:
        aligned = run(scene)
        true_S_map, metres, degrees = against_truth(aligned, scene)
        assert abs(true_S_map.scale - 1) < 0.005
        # The map can't know better than its phones: their mean error is in it, and little else.
        assert 1 / true_S_map.scale == pytest.approx(scene.phone_scales.mean(), abs=0.0015)
        assert np.degrees(np.arccos(true_S_map.rotation[1, 1])) < 0.2
        assert np.median(metres) < 0.02 and np.median(degrees) < 0.1
        assert (aligned.checks["status"] == "passed").all()
        own = aligned.sessions["scale"] * aligned.main.map_S_sfm.scale * walks.gauge.scale
        np.testing.assert_allclose(own, scene.phone_scales, atol=0.005)


def test_a_tenth_of_wrong_frames_is_found_and_moves_nothing(walks: Walks) -> None:
    scene = walks.make(**PHONES | {"sessions": 3})
    clean = run(scene)
    rng = np.random.default_rng(5)
    sfm = poses_of(scene.images, "sfm_cam")
    wrong = rng.choice(len(sfm), len(sfm) // 10, replace=False)
    sfm[wrong, :3, 3] += walks.gauge.scale * rng.uniform(1, 10, (len(wrong), 1)) * rng.choice([-1, 1], (len(wrong), 3))
    scene.set_sfm(sfm)
    aligned = run(scene)
    refused = aligned.ground_truth["quality"].to_numpy() == "none"
    assert refused[wrong].all()
    assert refused.sum() <= 1.1 * len(wrong)
    assert aligned.main.map_S_sfm.scale == pytest.approx(clean.main.map_S_sfm.scale, rel=0.002)
    kept = ~refused
    assert position_error(ground_truth(aligned)[kept], ground_truth(clean)[kept]).max() < 0.15


def test_a_session_with_another_scale_is_named_and_left_out_of_the_mean(walks: Walks) -> None:
    scene = walks.make(**PHONES | {"sessions": 4, "frames": 40})
    vio = poses_of(scene.frames, "vio_cam")
    vio[80:120, :3, 3] *= 1.1
    scene.set_vio(vio)
    aligned = run(scene)
    assert abs(against_truth(aligned, scene)[0].scale - 1) < 0.005
    failed = aligned.checks[(aligned.checks["status"] == "failed") & (aligned.checks["check"] == "session_scale")]
    assert failed["session_id"].tolist() == ["walk2"]
    scale = aligned.sessions.set_index("session_id")["scale"]
    assert scale["walk2"] == pytest.approx(1.1, abs=0.01)


def test_a_jumping_session_is_aligned_by_segment(walks: Walks) -> None:
    scene = walks.make()
    vio = poses_of(scene.frames, "vio_cam")
    jump = make_pose(Rotation.from_euler("y", 20, degrees=True).as_matrix(), [3.0, 0, 1])
    vio[80:120] = jump @ vio[80:120]
    scene.set_vio(vio)
    at = scene.frames["t_ns"].iloc[80]
    scene.jumps = pd.DataFrame({"session_id": ["walk1"], "t_ns": [at], "jump_m": [3.2], "jump_deg": [20.0]})
    aligned = run(scene)
    sessions = aligned.sessions
    assert sessions[["session_id", "segment", "frames"]].to_numpy().tolist() == [
        ["walk0", 0, 60],
        ["walk1", 0, 20],
        ["walk1", 1, 40],
        ["walk2", 0, 60],
    ]
    assert sessions["position_max_m"].max() < 1e-8
    assert (aligned.checks["status"] == "passed").all()
    np.testing.assert_allclose(aligned.fits[1].map_T_vio, aligned.fits[2].map_T_vio @ jump, atol=1e-8)


def test_an_unannounced_jump_costs_the_frames_around_it_only(walks: Walks) -> None:
    """A break that import didn't see as VIO's is the model's: there is no ground truth beside it."""
    scene = walks.make()
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[90:120, :3, 3] += walks.gauge.scale * np.array([2.0, 0, 1])
    scene.set_sfm(sfm)
    aligned = run(scene)
    refused = np.flatnonzero(aligned.ground_truth["quality"] == "none")
    assert len(refused) > 0 and refused.min() >= 80 and refused.max() < 100
    assert set(aligned.ground_truth["reason"].iloc[refused]) == {"pose in SfM inconsistent with VIO"}


def test_unregistered_frames_have_a_row_and_no_pose(walks: Walks) -> None:
    scene = walks.make()
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[10:15] = np.nan
    scene.set_sfm(sfm)
    scene.images.loc[10:14, "registered"] = False
    scene.images.loc[10:14, "not_registered"] = NotRegistered.NO_VERIFIED_PAIRS
    scene.images.loc[20:24, "covariance"] = None
    gt = run(scene).ground_truth
    assert len(gt) == len(scene.frames)
    assert (gt["quality"].iloc[10:15] == "none").all() and gt["map_cam_tx"].iloc[10:15].isna().all()
    assert (gt["reason"].iloc[10:15] == "SfM didn't register it: no verified pairs").all()
    assert gt["covariance"].iloc[20:25].isna().all() and (gt["quality"].iloc[20:25] == "C").all()


def test_support_frames_help_to_judge_the_model_and_are_in_no_table(walks: Walks) -> None:
    scene = walks.make(**PHONES)
    whole = run(scene)
    support = np.arange(len(scene.frames)) % 3 == 1
    scene.frames["support"] = support
    aligned = run(scene)
    # All frames say where the map is, those of the dataset get ground truth in it.
    np.testing.assert_allclose(ground_truth(aligned), ground_truth(whole)[~support], atol=1e-12)
    dataset = scene.frames["frame_id"][~support].tolist()
    assert aligned.ground_truth["frame_id"].tolist() == dataset
    assert aligned.ground_truth["quality"].tolist() == whole.ground_truth["quality"][~support].tolist()
    assert set(aligned.residuals["frame_id"]) == set(dataset)
    assert aligned.sessions[["frames", "registered", "with_ground_truth"]].to_numpy().tolist() == [[40, 40, 40]] * 5
    np.testing.assert_allclose(aligned.sessions["scale"], whole.sessions["scale"], rtol=1e-12)
    per_pair = aligned.drift[(aligned.drift["definition"] == "paper_rpe") & (aligned.drift["interval_unit"] == "pair")]
    assert per_pair.set_index("session_id")["samples"]["all"] == 5 * 39


def test_support_frames_that_are_not_registered_cost_the_dataset_nothing(walks: Walks) -> None:
    scene = walks.make()
    scene.frames["support"] = np.arange(len(scene.frames)) % 3 > 0
    scene.images.loc[scene.frames["support"], "registered"] = False
    aligned = run(scene)
    assert len(aligned.ground_truth) == 60 and (aligned.ground_truth["quality"] != "none").all()
    registered = aligned.checks[aligned.checks["check"] == "registered"]
    assert registered[["frames", "value"]].to_numpy().tolist() == [[60, 1.0]]
    scene.images["registered"] = scene.frames["support"]
    for least in (0.9, 0.0):
        with pytest.raises(UserError, match="too few frames") as error:
            run(scene, min_registered_fraction=least)
        assert "0 of 60 (0%)" in str(error.value)


@pytest.mark.parametrize(("of_three", "what"), [(0, "registered no frame"), (1, "too few frames")])
def test_too_few_registered_frames_are_refused(walks: Walks, of_three: int, what: str) -> None:
    scene = walks.make(frames=30)
    scene.images.loc[np.arange(90) % 3 >= of_three, "registered"] = False
    with pytest.raises(UserError, match=what) as error:
        run(scene)
    assert f"{30 * of_three} of 90" in str(error.value)


@pytest.mark.parametrize("changes", [{"frames": 1}, {"speed_m": 0.0, "sfm_m": 0.002}, {}])
def test_without_motion_or_vio_the_map_is_upright_and_in_a_unit_of_its_own(
    walks: Walks, changes: dict[str, Any]
) -> None:
    scene = walks.make(**{"frames": 10, "jitter_m": 0.002} | changes)
    if not changes:
        scene.set_vio(np.full((30, 4, 4), np.nan))
    aligned = run(scene)
    gt = aligned.ground_truth
    assert set(gt["scale_source"]) == {"none"} and set(aligned.sessions["scale_source"]) == {"none"}
    assert set(gt["reason"]) == {"class C: the map has no metric scale"}
    turned = ground_truth(aligned)[:, :3, :3] @ np.swapaxes(scene.true_T_cam[:, :3, :3], 1, 2)
    assert turned[:, 1, 1].min() > np.cos(np.radians(0.5))
    assert np.isfinite(np.stack(list(gt["covariance"]))).all()
    assert aligned.drift.empty and aligned.residuals.empty
    scale = aligned.checks[aligned.checks["check"] == "map_scale"]
    assert scale["status"].tolist() == ["undecided"] and "ruler" in scale["advice"].iloc[0]


GRAVITY = ["gravity_x", "gravity_y", "gravity_z"]


def tilt_vio(scene: Scene, number: int, degrees: float) -> None:
    """Another world for a walk's VIO, of which it takes +y to be up."""
    rows = scene.frames.index[scene.frames["session_id"] == f"walk{number}"]
    world = make_pose(Rotation.from_euler("xz", [degrees, 20], degrees=True).as_matrix(), [1.0, 2.0, 3.0])
    vio = poses_of(scene.frames, "vio_cam")
    vio[rows] = world @ vio[rows]
    scene.set_vio(vio)
    scene.frames.loc[rows, GRAVITY] = -vio[rows, 1, :3]


def test_without_gravity_the_map_is_metric_and_has_no_vertical(walks: Walks) -> None:
    scene = walks.make(frames=20)
    for number in range(3):
        tilt_vio(scene, number, 40)
    scene.frames[GRAVITY] = np.nan
    aligned = run(scene)
    true_S_map, metres, degrees = against_truth(aligned, scene)
    assert true_S_map.scale == pytest.approx(1, abs=1e-9)
    assert metres.max() < 1e-9 and degrees.max() < 1e-6
    gt = aligned.ground_truth
    assert set(gt["vertical_source"]) == {"none"} and set(gt["quality"]) == {"A"}
    # No part of the covariance is a tilt of axes that may be any; its axes are those of the first session's VIO.
    assert np.isfinite(np.stack(list(gt["covariance"]))).all()
    np.testing.assert_allclose(aligned.fits[0].map_T_vio, np.eye(4), atol=1e-9)
    assert aligned.sessions["map_vio_tx"].notna().all()
    assert not {"yaw_rate", "ate_yaw"} & set(aligned.drift["definition"])
    vertical = aligned.checks.set_index("check").loc["map_vertical"]
    assert vertical["status"] == "undecided" and "gravity" in vertical["advice"]


def test_a_session_without_gravity_is_in_the_map_of_the_others(walks: Walks) -> None:
    scene = walks.make(frames=20)
    tilt_vio(scene, 0, 40)
    scene.frames.loc[scene.frames["session_id"] == "walk0", GRAVITY] = np.nan
    aligned = run(scene)
    true_S_map, metres, _ = against_truth(aligned, scene)
    assert true_S_map.rotation[1, 1] == pytest.approx(1, abs=1e-9) and metres.max() < 1e-9
    assert (aligned.checks["status"] == "passed").all()
    assert set(aligned.ground_truth["vertical_source"]) == {"gravity"}
    # Origin and heading are those of the first session that knows what is up.
    np.testing.assert_allclose(aligned.fits[1].map_T_vio, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("wrong", [0, 1])
def test_of_two_sessions_whose_gravity_differs_none_is_named_unless_images_tell(walks: Walks, wrong: int) -> None:
    scene = walks.make(frames=20, sessions=2)
    tilt_vio(scene, wrong, 40)
    aligned = run(scene)
    checks = aligned.checks[aligned.checks["check"] == "session_vertical"]
    assert checks["status"].tolist() == ["undecided"] * 2
    assert set(aligned.ground_truth["vertical_source"]) == {"none"} and set(aligned.ground_truth["quality"]) == {"A"}

    tested = align(scene.inputs(gravity_tested=frozenset({f"walk{1 - wrong}"})), AlignSettings())
    failed = tested.checks[tested.checks["status"] == "failed"]
    assert failed[["check", "session_id", "cause"]].to_numpy().tolist() == [
        ["session_vertical", f"walk{wrong}", "wrong VIO gravity"]
    ]
    true_S_map, _, _ = against_truth(tested, scene)
    assert true_S_map.rotation[1, 1] == pytest.approx(1, abs=1e-9)
