"""Which faults the checks find, by which cause, and what passes: synthetic walks, broken one way at a time."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import CheckedMap, check_models, refusal
from groundwalk.alignment.checks.results import CheckResult, main_failure, with_status
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.choices import FailureCause
from groundwalk.store.tables import poses_of
from tests.known import there
from tests.synthetic_walks import Scene, Walks

FRAMES = 30
NOISE = {"frames": FRAMES, "sfm_m": 0.01, "sfm_deg": 0.05, "drift_m": 0.01, "drift_yaw_deg": 0.1, "phone_scale": 0.002}


@pytest.fixture
def scene(walks: Walks) -> Scene:
    return walks.make(**NOISE)


def run(scene: Scene) -> CheckedMap:
    return check_models(scene.inputs(), AlignSettings())


def error(scene: Scene, found: CheckedMap) -> UserError | None:
    return refusal(found, scene.frames, AlignSettings())


def of_walk(scene: Scene, number: int) -> np.ndarray:
    """Rows of one walk."""
    return np.flatnonzero(scene.frames["session_id"] == f"walk{number}")


def faults(found: CheckedMap) -> set[tuple[FailureCause | None, str]]:
    """Causes and sessions of all failed checks but those of windows."""
    return {(c.cause, c.subject.session_id) for c in failed(found) if not c.name.startswith("window")}


def failed(found: CheckedMap) -> list[CheckResult]:
    return with_status(found.checks, Status.FAILED)


def without_ground_truth(found: CheckedMap) -> set[int]:
    """Numbers of the walks that get no ground truth at all."""
    return {walk for walk, used in enumerate(found.frames.has_ground_truth.reshape(-1, FRAMES)) if not used.any()}


def mirror(scene: Scene, rows: np.ndarray, axis: int) -> None:
    """SfM poses as mirrored images give them: the mirror image of the motion, in a gauge of its own."""
    flip = np.ones(4)
    flip[axis] = -1
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[rows] = np.diag(flip) @ sfm[rows] @ np.diag(flip)
    scene.set_sfm(sfm)


@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_images_are_named(scene: Scene, axis: int) -> None:
    mirror(scene, of_walk(scene, 1), axis)
    found = run(scene)
    assert (FailureCause.MIRRORED_IMAGES, "walk1") in faults(found) and without_ground_truth(found) == {1}
    mirror(scene, np.concatenate([of_walk(scene, 0), of_walk(scene, 2)]), axis)
    found = run(scene)
    assert FailureCause.MIRRORED_IMAGES in there(error(scene, found)).what and not found.frames.has_ground_truth.any()


def shuffle(scene: Scene, rows: np.ndarray) -> None:
    """SfM poses of images that were swapped among each other."""
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[rows] = sfm[np.random.default_rng(0).permutation(rows)]
    scene.set_sfm(sfm)


def turn_otherwise(scene: Scene, rows: np.ndarray, gain: float) -> None:
    """SfM poses that turn `gain` times as far from one to the next, their steps right in their own axes."""
    sfm = poses_of(scene.images, "sfm_cam")
    turned = [sfm[rows[0]]]
    for a, b in pairwise(rows):
        motion = np.linalg.inv(sfm[a]) @ sfm[b]
        vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec() * gain
        turned.append(turned[-1] @ make_pose(Rotation.from_rotvec(vector).as_matrix(), motion[:3, 3]))
    sfm[rows] = turned
    scene.set_sfm(sfm)


@pytest.mark.parametrize("gain", [0.91, 1.11])
def test_wrong_intrinsics_are_named(scene: Scene, gain: float) -> None:
    """SfM that turns about a tenth too little or too much, its steps right: what a wrong focal length does."""
    turn_otherwise(scene, of_walk(scene, 0), gain)
    found = run(scene)
    assert (FailureCause.WRONG_INTRINSICS, "walk0") in faults(found) and not found.frames.has_ground_truth.any()
    assert FailureCause.WRONG_INTRINSICS in there(error(scene, found)).what


def test_folded_places_cost_the_whole_model(scene: Scene) -> None:
    """The second half of a walk laid on its first half, as look-alike places do."""
    rows = of_walk(scene, 0)
    sfm = poses_of(scene.images, "sfm_cam")
    half = FRAMES // 2
    sfm[rows[half:]] = sfm[rows[:half]]
    vio = poses_of(scene.frames, "vio_cam")
    step = make_pose(np.eye(3), vio[rows[half], :3, 3] - vio[rows[0], :3, 3])
    vio[rows[half:]] = step @ vio[rows[:half]]
    scene.set_vio(vio)
    scene.set_sfm(sfm)
    found = run(scene)
    assert (FailureCause.PERCEPTUAL_ALIASING, "walk0") in faults(found) and not found.frames.has_ground_truth.any()
    assert FailureCause.PERCEPTUAL_ALIASING in there(error(scene, found)).what


def test_a_single_wrong_frame_is_no_fold(scene: Scene) -> None:
    sfm = poses_of(scene.images, "sfm_cam")
    sfm[25] = sfm[5]
    scene.set_sfm(sfm)
    found = run(scene)
    assert (
        not faults(found)
        and not found.frames.has_ground_truth[25]
        and found.frames.has_ground_truth.sum() == len(sfm) - 1
    )


def test_a_session_of_another_scene_is_named(scene: Scene) -> None:
    """It comes as a model of its own that no session shares, or not at all."""
    rows = of_walk(scene, 2)
    scene.images.loc[rows, "model_id"] = "incremental/1"
    found = run(scene)
    assert faults(found) == {(FailureCause.OTHER_SCENE, "")} and without_ground_truth(found) == {2}
    assert "walk2" in there(main_failure(found.checks)).reason

    scene.images.loc[rows, "registered"] = False
    scene.images.loc[rows, "model_id"] = None
    found = run(scene)
    assert faults(found) == {(FailureCause.OTHER_SCENE, "walk2")} and without_ground_truth(found) == {2}


def cut_off(scene: Scene, rows: np.ndarray) -> dict[str, str]:
    """These rows as a session of their own, as import cuts them off at a VIO jump; the recording of each session."""
    recordings = scene.recordings
    session = scene.frames["session_id"].iloc[rows[0]]
    scene.frames.loc[rows, "session_id"] = f"{session}.part2"
    return recordings | {f"{session}.part2": session}


@pytest.mark.parametrize(
    ("scale", "sd", "status"),
    [
        (1.025, 0.001, Status.PASSED),
        # Its standard error is in the frames' covariances: no frame has a lower class for it.
        (1.05, 0.015, Status.UNDECIDED),
        (1.16, 0.005, Status.FAILED),
    ],
)
def test_focal_lengths_that_the_images_deny_are_named_where_motion_hides_them(
    scene: Scene, scale: float, sd: float, status: Status
) -> None:
    scene.set_focal("walk0", scale, sd)
    found = run(scene)
    (check,) = [c for c in found.checks if c.name == "session_focal_length"]
    assert check.status is status and found.frames.has_ground_truth.all() == (status is not Status.FAILED)
    if status is Status.FAILED:
        assert check.cause == FailureCause.WRONG_INTRINSICS and error(scene, found) is not None
    else:
        assert not found.frames.problem.any()


def test_turns_are_odometrys_fault_where_the_images_confirm_the_focal_length(scene: Scene) -> None:
    turn_otherwise(scene, of_walk(scene, 1), 0.9)
    assert (FailureCause.WRONG_INTRINSICS, "walk1") in faults(run(scene))
    scene.set_focal("walk1", 1.001, 0.001)
    assert (FailureCause.WRONG_INTRINSICS, "walk1") not in faults(run(scene))


def test_images_whose_pairs_move_as_vio_belong_to_its_poses(scene: Scene) -> None:
    rows = of_walk(scene, 1)
    shuffle(scene, rows)
    found = run(scene)
    assert faults(found) == {(FailureCause.MISMATCHED_IMAGES, "walk1")} and without_ground_truth(found) == {1}
    assert "no relation" in found.frames.exclusion[rows[0]]
    ids = scene.frames["frame_id"].to_numpy()[rows]
    scene.pairs = pd.DataFrame({"frame_id_a": ids[:-1], "frame_id_b": ids[1:]}).assign(
        status="verified", rotation_deg=0.1
    )
    named = {cause for cause, session in faults(run(scene)) if session == "walk1"}
    assert named and FailureCause.MISMATCHED_IMAGES not in named


@pytest.mark.parametrize("registered", [False, True])
def test_what_a_vio_jump_cut_off_is_no_other_scene(scene: Scene, registered: bool) -> None:
    """A few frames that nothing ties to the map, by view or by VIO: not in the model, or in one of their own."""
    rows = of_walk(scene, 2)[-8:]
    recordings = cut_off(scene, rows)
    scene.images.loc[rows, "model_id"] = "incremental/1" if registered else None
    scene.images.loc[rows, "registered"] = registered
    found = check_models(scene.inputs(recordings=recordings), AlignSettings())
    assert {cause for cause, _ in faults(found)} == ({FailureCause.DISCONNECTED_SESSION} if registered else set())
    assert found.frames.has_ground_truth.sum() == 3 * FRAMES - 8
