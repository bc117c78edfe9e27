"""Maps in the frame of a reference: walks without VIO whose true poses, or wrong ones, are stated."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import check_models
from groundwalk.alignment.definition import STAGE
from groundwalk.alignment.ground_truth import AlignResult, build
from groundwalk.alignment.plot import draw_checks
from groundwalk.alignment.reference.agreement import describe_agreement
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import inverse, make_pose
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.colours import GROUND_TRUTH, REJECTED, VIO
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema, stage_tables
from groundwalk.store.tables import pose_frame, poses_of, read_table
from tests.known import put, table_of, there, without_vio
from tests.synthetic_walks import Scene, Walks, align

WORLD = Sim3(1.0, Rotation.from_euler("xyz", [0.9, -0.2, 1.5]).as_matrix(), np.array([100.0, -20.0, 4.0]))


def of_images(scene: Scene) -> Scene:
    return replace(scene, frames=without_vio(scene.frames))


def stated(map_T_cam: np.ndarray, **changes: Any) -> Reference:
    return replace(Reference(map_T_cam, is_metric=True, is_up_known=False, gives_map=True), **changes)


def run(scene: Scene, reference: Reference | None) -> AlignResult:
    return align(scene.inputs(reference=reference), AlignSettings())


@pytest.mark.parametrize("unit", [1.0, 7.3])
def test_the_map_is_the_references_frame(walks: Walks, unit: float) -> None:
    scene = of_images(walks.make(sfm_m=0.005, sfm_deg=0.02, sessions=2))
    world = replace(WORLD, scale=unit)
    reference = stated(world.poses(scene.true_T_cam), is_metric=unit == 1.0)
    aligned = run(scene, reference)
    gt = aligned.ground_truth
    found = poses_of(gt, "map_cam")
    np.testing.assert_allclose(found[:, :3, 3], reference.map_T_cam[:, :3, 3], atol=0.03 * unit)
    np.testing.assert_allclose(found[:, :3, :3], reference.map_T_cam[:, :3, :3], atol=2e-3)
    assert set(gt["quality"]) <= ({"A", "B"} if unit == 1.0 else {"C"})
    assert set(gt["scale_source"]) == {"reference" if unit == 1.0 else "reference, unit unknown"}
    assert set(gt["vertical_source"]) == {"reference, up unknown"}
    assert not gt["gt_uses_vio"].any()
    status = aligned.checks.set_index("check")["status"]
    assert status["reference_scale"] == ("passed" if unit == 1.0 else "undecided")
    assert status["reference_vertical"] == "passed" and (status["session_reference"] == "passed").all()
    table = aligned.reference_agreement
    assert table["compared_frames"].tolist() == [60, 60] and set(table["fit"]) == {"model_sim3"}
    assert (table["position_rms_m"] < 0.012 * unit).all() and (table["rotation_median_deg"] < 0.05).all()
    np.testing.assert_allclose(table["scale"].astype(float), 1.0, atol=1e-3)
    text = "\n".join(describe_agreement(table, gt))
    assert ("no stated unit" in text) == (unit != 1.0) and "60 reference poses" in text


def test_models_that_nothing_else_ties_lie_where_the_reference_has_them(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=2))
    scene.images.loc[scene.frames["session_id"] == "walk1", "model_id"] = "incremental/1"
    own = (scene.frames["session_id"] == "walk1").to_numpy()
    sfm_T_cam = poses_of(scene.images, "sfm_cam")
    sfm_T_cam[own] = Sim3(3.0, WORLD.rotation, WORLD.translation).poses(sfm_T_cam[own])
    scene.set_sfm(sfm_T_cam)
    gt = run(scene, stated(WORLD.poses(scene.true_T_cam))).ground_truth
    np.testing.assert_allclose(poses_of(gt, "map_cam"), WORLD.poses(scene.true_T_cam), atol=1e-6)
    assert gt["component"].value_counts().to_dict() == {0: 60, 1: 60} and not gt["gt_uses_vio"].any()


def test_frames_that_are_elsewhere_get_no_ground_truth(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=2))
    reference = WORLD.poses(scene.true_T_cam)
    reference[10:15, :3, 3] += [0.0, 5.0, 0.0]
    aligned = run(scene, stated(reference))
    wrong = aligned.ground_truth["quality"] == "none"
    assert np.flatnonzero(wrong).tolist() == list(range(10, 15))
    assert "SfM and reference inconsistent" in aligned.ground_truth["reason"][10]
    assert aligned.checks["status"].eq("passed").all()


def test_what_the_reference_does_not_confirm_is_class_c_and_turned_cameras_are_named(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=2))
    reference = WORLD.poses(scene.true_T_cam)
    reference[10:15, :3, 3] += [0.0, 0.3, 0.0]
    # As by a principal point that is off: each camera turned alike about its own axes.
    reference = reference @ make_pose(Rotation.from_euler("y", 0.8, degrees=True).as_matrix(), [0, 0, 0])
    aligned = run(scene, stated(reference))
    assert np.flatnonzero(aligned.ground_truth["quality"] == "C").tolist() == list(range(10, 15))
    text = "\n".join(describe_agreement(aligned.reference_agreement, aligned.ground_truth))
    (degrees, *_) = re.findall(r"turned by ([0-9.]+)° \(median\)", text)
    assert float(degrees) == pytest.approx(0.8, abs=0.05) and "principal point" in text


@pytest.mark.parametrize("seed", [79, 198])
def test_six_photos_that_agree_with_a_bad_reference_by_chance_are_not_class_a(walks: Walks, seed: int) -> None:
    scene = of_images(walks.make(seed=seed, frames=6, sessions=1, speed_m=0.08, sfm_m=0.001, sfm_deg=0.02))
    rng, reference = np.random.default_rng(seed), WORLD.poses(scene.true_T_cam)
    reference[:, :3, 3] += rng.normal(0, 0.02, (6, 3))
    reference[:, :3, :3] @= Rotation.from_rotvec(np.radians(3) * rng.normal(size=(6, 3))).as_matrix()
    checked = check_models(scene.inputs(reference=stated(reference)), AlignSettings())
    quality = build(scene.frames, scene.images, checked, stated(reference)).ground_truth["quality"]
    assert set(quality) <= {"C", "none"}


def test_a_session_in_another_world_is_refused_by_name(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=3))
    reference = WORLD.poses(scene.true_T_cam)
    own = (scene.frames["session_id"] == "walk1").to_numpy()
    reference[own] = scene.true_T_cam[own]
    aligned = run(scene, stated(reference))
    assert set(aligned.ground_truth.loc[own, "quality"]) == {"none"}
    assert "its world is another one" in aligned.ground_truth.loc[own, "reason"].iloc[0]
    (failed,) = aligned.checks[aligned.checks["status"] == "failed"].to_dict("records")
    assert (failed["check"], failed["session_id"]) == ("session_reference", "walk1")
    assert failed["cause"] == "SfM and reference inconsistent"


def test_how_far_frames_are_away_is_of_those_that_are(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=3))
    reference = WORLD.poses(scene.true_T_cam)
    reference[60:93, 1, 3] += 50.0
    (failed,) = run(scene, stated(reference)).checks.query("status == 'failed'")["reason"]
    assert failed.startswith("33 of 60 frames of walk1 are away from their reference poses, by 50 ")


def test_a_reference_that_nothing_agrees_with_is_refused(walks: Walks) -> None:
    scene = of_images(walks.make(sessions=2))
    shuffled = WORLD.poses(scene.true_T_cam)[np.random.default_rng(0).permutation(len(scene.frames))]
    with pytest.raises(UserError, match="SfM and reference inconsistent"):
        run(scene, stated(shuffled))
    still = np.broadcast_to(np.eye(4), (len(scene.frames), 4, 4))
    with pytest.raises(UserError, match="can't be aligned to the reference") as error:
        run(scene, stated(still))
    assert "one place" in str(error.value)


AXES = "camera y and z axes have the other sign"
TURNED = make_pose(Rotation.from_euler("y", 8, degrees=True).as_matrix(), [0, 0, 0])
ROBOT = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x forward, y left, z up


@pytest.mark.parametrize(
    ("scale", "mistake", "said"),
    [
        (0.02, lambda pose: pose @ np.diag([1.0, -1, -1, 1]), AXES),
        (1.0, inverse, "poses are world to camera, in OpenCV's axes"),
        (1000.0, lambda pose: pose @ make_pose(ROBOT.T, [0, 0, 0]), "turned alike, by 120.0 degrees; the stated x"),
        (1.0, lambda pose: pose @ TURNED, "turned alike, by 8.0 degrees: as by a principal point"),
    ],
    ids=["axes", "inverse", "robot", "principal_point"],
)
def test_a_wrong_convention_is_named(
    walks: Walks, scale: float, mistake: Callable[[np.ndarray], np.ndarray], said: str
) -> None:
    scene = of_images(walks.make(sessions=2, sfm_m=0.005, sfm_deg=0.02))
    reference = mistake(replace(WORLD, scale=scale).poses(scene.true_T_cam))
    with pytest.raises(UserError, match=re.escape(said)):
        run(scene, stated(reference, is_metric=False))


def test_where_a_model_bends_is_named_and_drawn(walks: Walks, tmp_path: Path) -> None:
    """A walk whose second half is turned by 25 degrees about the point in its middle."""
    scene = of_images(walks.make(sessions=1, sfm_m=0.005, sfm_deg=0.02))
    reference = scene.true_T_cam.copy()
    at, turn = len(reference) // 2, Rotation.from_euler("y", 25, degrees=True).as_matrix()
    middle = reference[at, :3, 3]
    reference[at:] = Sim3(1.0, turn, middle - turn @ middle).poses(reference[at:])
    inputs = scene.inputs(reference=stated(reference, is_metric=False))
    found = check_models(inputs, AlignSettings(max_reference_error_deg=1.0))
    (failed,) = (check for check in found.checks if check.status is Status.FAILED)
    ((first, last),) = re.findall(r"most between walk0/(\d+) and walk0/(\d+)", failed.reason)
    assert int(first) <= at <= int(last) and int(last) - int(first) < 0.4 * len(reference), failed.reason
    (degrees,) = re.findall(r"up to ([0-9.]+) degrees", failed.reason)
    assert 12 < float(degrees) < 26 and "can't be told from them alone" in failed.reason
    draw_checks(tmp_path / "checks.png", found, inputs.reference, "Place", simulated=True)
    pixels = cv2.imread(str(tmp_path / "checks.png"))
    for colour in (GROUND_TRUTH, VIO, REJECTED):  # SfM's path, the reference's, frames beyond the limit
        assert (np.abs(there(pixels).astype(int) - colour[::-1]).max(axis=-1) < 40).sum() > 30


@pytest.mark.parametrize("metric", [True, False])
def test_beside_vio_a_reference_is_compared_and_gives_nothing(walks: Walks, metric: bool) -> None:
    scene = walks.make(sessions=2)
    plain = run(scene, None)
    reference = stated(replace(WORLD, scale=1.02).poses(scene.true_T_cam), is_metric=metric, gives_map=False)
    beside = run(scene, reference)
    pd.testing.assert_frame_equal(plain.ground_truth, beside.ground_truth)
    assert set(beside.ground_truth["scale_source"]) == {"vio"} and not len(plain.reference_agreement)
    table = beside.reference_agreement
    np.testing.assert_allclose(table["scale"].astype(float), 1.02, atol=1e-3)
    assert set(table["fit"]) == {"se3" if metric else "sim3"}
    # A rigid fit leaves the scale's 2 %.
    assert (table["position_rms_m"].astype(float) > 0.05).all() == metric


def test_a_map_without_scale_is_compared_with_a_metric_reference_up_to_scale(walks: Walks) -> None:
    scene = walks.make(sessions=1)
    still = poses_of(scene.frames, "vio_cam")
    still[:, :3, 3] = 0.0
    scene.set_vio(still)
    aligned = run(scene, stated(scene.true_T_cam, gives_map=False))
    assert set(aligned.ground_truth["scale_source"]) == {"none"}
    (row,) = aligned.reference_agreement.to_dict("records")
    assert row["fit"] == "sim3" and row["position_rms_m"] < 1e-3


def test_the_stage_says_what_gave_scale_and_vertical(data: DataRoot) -> None:
    frames = without_vio(table_of(data, "Place", "import", "frames"))
    put(data, "Place", "import", "frames", frames)
    truth = read_table(data.captures("Place") / "true_poses.parquet", schema("simulate", "true_poses"))
    poses = pose_frame("map_cam", poses_of(truth, "map_cam"))
    put(data, "Place", "import", "reference", frames[["frame_id", "session_id", "t_ns"]].join(poses))
    origin = {"x": 4186460.0, "y": 834910.0, "z": 4723430.0}
    sessions = table_of(data, "Place", "import", "sessions")
    sessions = sessions.assign(pose_source="reference", reference_unit="m", up="+y")
    sessions = sessions.assign(**{f"reference_origin_{axis}": value for axis, value in origin.items()})
    put(data, "Place", "import", "sessions", sessions)
    out = execute(STAGE, "Place", "tiny", data)
    tables = {t.name: read_table(out / f"{t.name}.parquet", t) for t in stage_tables("align")}
    assert (out / "checks.png").is_file() and (out / "recording.rrd").stat().st_size > 1000
    figures = load_manifest(out)["figures"]
    assert (figures["scale_source"], figures["vertical_source"]) == ("reference", "reference")
    assert {axis: figures[f"map_origin_{axis}"] for axis in "xyz"} == origin
    assert figures["with_ground_truth"] == 40 and (tables["reference_agreement"]["position_rms_m"] < 0.02).all()
    assert len(tables["reference_agreement"]) == 2 and not len(tables["residuals"]) and not len(tables["drift"])
