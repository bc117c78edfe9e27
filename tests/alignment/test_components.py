"""Models that nothing visual ties together: each aligned to VIO, joined by VIO within its drift, or left out."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.components import VioLink
from groundwalk.alignment.ground_truth import AlignResult
from groundwalk.alignment.settings import AlignSettings
from groundwalk.geometry.fits import Sim3, fit_sim3
from groundwalk.geometry.poses import make_pose, path_length, yaw_rotation
from groundwalk.scoring.errors import position_error
from groundwalk.store.choices import FailureCause
from groundwalk.store.tables import poses_of
from tests.synthetic_walks import Scene, Walks, align

NOISE = {"sfm_m": 0.005, "sfm_deg": 0.03, "drift_m": 0.01, "drift_yaw_deg": 0.1}
OTHER_GAUGE = Sim3(2.1, Rotation.from_euler("xyz", [1.0, 0.2, -0.7]).as_matrix(), np.array([-4.0, 9.0, 2.0]))


def split(scene: Scene, rows: np.ndarray) -> None:
    """These rows as a second model in a gauge of its own."""
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[rows] = OTHER_GAUGE.poses(sfm[rows])
    scene.set_sfm(sfm)
    scene.images.loc[rows, "model_id"] = "incremental/1"


def drop(scene: Scene, rows: np.ndarray) -> None:
    scene.images.loc[rows, "registered"] = False
    scene.images.loc[rows, "model_id"] = None


def run(scene: Scene, **settings: Any) -> AlignResult:
    return align(scene.inputs(), AlignSettings(**settings))


def walk_along(walks: Walks, xyz: np.ndarray) -> Scene:
    """One session along positions (N, 3), without noise, its cameras turning to and fro."""
    scene = walks.make(sessions=1, frames=len(xyz))
    turned = yaw_rotation(0.5 * np.sin(np.arange(len(xyz)) / 5)) @ np.diag([1.0, -1.0, -1.0])
    scene.true_T_cam = make_pose(turned, xyz + np.outer(0.05 * np.sin(np.arange(len(xyz))), [0, 1, 0]))
    scene.set_vio(scene.true_T_cam)
    for axis, values in zip("xyz", -scene.true_T_cam[:, 1, :3].T, strict=True):
        scene.frames[f"gravity_{axis}"] = values
    scene.set_sfm(walks.gauge.poses(scene.true_T_cam))
    return scene


def errors(aligned: AlignResult, scene: Scene) -> np.ndarray:
    """Position errors (N,) after a similarity fit of the first model, NaN without ground truth."""
    gt = poses_of(aligned.ground_truth, "map_cam")
    first = (aligned.ground_truth["component"] == 0).to_numpy(bool, na_value=False)
    true_S_map = fit_sim3(scene.true_T_cam[first, :3, 3], gt[first, :3, 3])
    return position_error(true_S_map.poses(gt), scene.true_T_cam)


def test_without_drift_two_models_of_one_walk_come_out_as_one(walks: Walks) -> None:
    scene = walks.make(sessions=1)
    split(scene, np.arange(35, 60))
    aligned = run(scene)
    gt = aligned.ground_truth
    assert gt["component"].tolist() == [0] * 35 + [1] * 25
    assert gt["gt_uses_vio"].tolist() == [False] * 35 + [True] * 25
    assert errors(aligned, scene).max() < 1e-8
    assert aligned.sessions[["segment", "component", "frames"]].to_numpy().tolist() == [[0, 0, 35], [0, 1, 25]]
    assert aligned.sessions["vio_link_m"].isna().tolist() == [True, False]
    assert (aligned.checks["status"] == "passed").all()


def test_a_link_is_as_good_as_its_covariance_says(walks: Walks) -> None:
    far, stated = [], []
    for seed in range(5):
        scene = walks.make(**NOISE | {"seed": seed, "sessions": 1, "drift_m": 0.028, "drift_yaw_deg": 0.5})
        split(scene, np.arange(35, 60))
        drop(scene, np.arange(35, 38))
        # VIO that strays so far tells nothing of the focal length; the images do.
        scene.set_focal("walk0", 1.0, 0.01)
        aligned = run(scene)
        gt = aligned.ground_truth
        assert aligned.sessions["vio_link_m"].iloc[1] == pytest.approx(4.8, rel=0.2)
        end = int(np.flatnonzero((gt["component"] == 1).to_numpy(bool, na_value=False))[-1])
        assert gt["position_sd_m"].iloc[end] > 0.1 > gt["position_sd_m"].iloc[10]
        assert gt["quality"].iloc[end] == "C" and gt["quality"].iloc[10] == "A"
        far.append(errors(aligned, scene)[end])
        stated.append(gt["position_sd_m"].iloc[end])
    ratio = np.sqrt(np.mean(np.square(far))) / np.sqrt(np.mean(np.square(stated)))
    assert 0.3 < ratio < 1.6


@pytest.mark.parametrize("has_gravity", [True, False])
def test_a_linked_model_without_a_vertical_is_as_upright_as_its_link(walks: Walks, has_gravity: bool) -> None:
    scene = walks.make(**NOISE | {"sessions": 2})
    split(scene, np.arange(95, 120))
    drop(scene, np.arange(92, 95))
    if not has_gravity:
        scene.frames.loc[60:, ["gravity_x", "gravity_y", "gravity_z"]] = np.nan
    gt = run(scene).ground_truth
    turns = np.sqrt(np.array([np.diag(np.reshape(c, (6, 6)))[:3] for c in gt["covariance"].iloc[[10, 110]]]))
    assert gt["gt_uses_vio"].iloc[110]
    assert (turns[1, [0, 2]] > 3 * turns[0, [0, 2]]).all() == (not has_gravity)


def test_link_covariance_is_that_of_samples() -> None:
    rng = np.random.default_rng(1)
    link = VioLink("walk", 1.0, 2.0, np.array([1.0, 2, 3]), 0.05, 0.02)
    pose = make_pose(Rotation.random(rng=rng).as_matrix(), [4.0, 2.5, -6])
    turn = 0.02 * rng.normal(size=40_000)
    moved = np.einsum("nij,j->ni", yaw_rotation(turn), pose[:3, 3] - link.anchor) + link.anchor
    moved += 0.05 * rng.normal(size=moved.shape)
    samples = np.hstack([np.stack([0 * turn, turn, 0 * turn], axis=1), moved - pose[:3, 3]])
    expected = link.covariance(pose[None, :3, 3])[0]
    np.testing.assert_allclose(np.cov(samples.T), expected, atol=0.02 * expected.max())


def test_a_longer_way_than_vio_may_be_trusted_for_is_no_link(walks: Walks) -> None:
    scene = walks.make(**NOISE | {"sessions": 1})
    split(scene, np.arange(45, 60))
    drop(scene, np.arange(30, 45))
    aligned = run(scene)
    gt = aligned.ground_truth
    assert (gt["quality"].iloc[45:] == "none").all() and (gt["component"].iloc[:30] == 0).all()
    assert "VIO path without a registered frame" in gt["reason"].iloc[50]
    (row,) = aligned.checks[(aligned.checks["status"] == "failed")].to_dict("records")
    assert (row["cause"], row["component"]) == (FailureCause.DISCONNECTED_SESSION, 1)


def test_sessions_that_place_a_model_differently_are_believed_neither(walks: Walks) -> None:
    scene = walks.make(**NOISE | {"sessions": 2})
    split(scene, np.r_[40:60, 100:120])
    assert (run(scene).ground_truth["quality"] != "none").all()
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[100:120, :3, 3] += OTHER_GAUGE.scale * walks.gauge.scale * np.array([4.0, 0, 3])
    scene.set_sfm(sfm)
    gt = run(scene).ground_truth
    assert (gt["quality"].iloc[40:60] == "none").all() and (gt["quality"].iloc[:40] != "none").all()
    assert "apart" in gt["reason"].iloc[50]


def test_a_model_without_motion_is_left_out(walks: Walks) -> None:
    scene = walks.make(sessions=1)
    vio = poses_of(scene.frames, "vio_cam")
    vio[50:, :3, 3] = vio[50, :3, 3]
    scene.set_vio(vio)
    split(scene, np.arange(50, 60))
    gt = run(scene).ground_truth
    assert (gt["quality"].iloc[50:] == "none").all() and "no metric scale" in gt["reason"].iloc[55]


def test_the_path_of_a_link_is_what_vio_walked_between_not_how_far_it_came(walks: Walks) -> None:
    # 15 m into a side way and back, of which SfM has no frame.
    there = [[20.0, 1.6, z] for z in range(15)]
    way = [[x, 1.6, 0.0] for x in range(20)] + there + there[::-1] + [[x, 1.6, 0.0] for x in range(22, 42)]
    scene = walk_along(walks, np.array(way, float))
    split(scene, np.arange(50, 70))
    drop(scene, np.arange(20, 50))
    aligned = run(scene)
    assert aligned.ground_truth["component"].isna()[20:].all()
    (link,) = aligned.checks[aligned.checks["check"] == "component_link"].to_dict("records")
    assert link["status"] == "failed" and "31." in link["reason"]
    # SfM's count is of frames that have no place in the map, too.
    assert aligned.sessions["registered"].sum() == 20


@pytest.mark.parametrize("registered", [True, False])
def test_a_place_seen_again_after_a_long_way_is_right_within_what_vio_drifts_on_that_way(
    walks: Walks, registered: bool
) -> None:
    straight = np.column_stack([np.linspace(0, 15, 30), np.full(30, 1.6), np.zeros(30)])
    angle = np.linspace(0, 2 * np.pi, 60)[1:-1]
    loop = straight[-1] + 60 / (2 * np.pi) * np.column_stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)])
    xyz = np.concatenate([straight, loop, straight[::-1] + np.array([0, 0, 0.05])])
    scene = walk_along(walks, xyz)
    strayed = scene.true_T_cam.copy()
    strayed[:, 2, 3] += 1.5 * np.clip(path_length(xyz) - 15, 0, 60) / 60  # 2.5 % of the loop
    scene.set_vio(strayed)
    if not registered:
        drop(scene, np.arange(30, 88))
    aligned = run(scene, min_registered_fraction=0.1)
    has_truth = aligned.ground_truth["quality"] != "none"
    assert has_truth.sum() == (118 if registered else 60)
