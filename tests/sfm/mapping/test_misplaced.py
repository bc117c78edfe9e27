"""Frames whose verified matches deny their poses are taken out of a model; no others are."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.sfm.mapping.misplaced import MatchCheck, misplaced
from groundwalk.sfm.mapping.source import Matches
from groundwalk.sfm.settings import SfmSettings
from tests.sfm.synthetic_model import log_of, synthetic_model

PAIRS = np.array(list(combinations(range(9), 2)))


def errors_of(wrong: dict[tuple[int, int], float]) -> tuple[np.ndarray, np.ndarray]:
    """Ten matches of each pair of nine frames, off by 0.1 px or as stated of pairs."""
    frames = np.repeat(PAIRS, 10, axis=0)
    return frames, np.array([wrong.get((a, b), 0.1) for a, b in frames.tolist()])


def test_the_frame_that_the_others_deny_is_misplaced_alone() -> None:
    frames, error_px = errors_of({(a, b): 5.0 for a, b in PAIRS.tolist() if 2 in (a, b)})
    assert misplaced(frames, error_px) == [2]


def test_frames_that_only_agree_among_themselves_are_misplaced() -> None:
    frames, error_px = errors_of({(a, b): 5.0 for a, b in PAIRS.tolist() if (a in (4, 5)) != (b in (4, 5))})
    assert sorted(misplaced(frames, error_px)) == [4, 5]


@pytest.mark.parametrize(("off_px", "rows"), [(0.5, [2]), (0.35, [])])
def test_the_limit_follows_the_errors_of_the_other_pairs(off_px: float, rows: list[int]) -> None:
    frames, error_px = errors_of({(a, b): off_px for a, b in PAIRS.tolist() if 2 in (a, b)})
    assert misplaced(frames, error_px) == rows


def test_no_frame_is_misplaced_where_all_are_off() -> None:
    frames, error_px = errors_of({(a, b): 3.0 + a for a, b in PAIRS.tolist()})
    assert misplaced(frames, error_px) == []


def test_one_wrong_pair_of_many_and_errors_that_are_unknown_are_borne() -> None:
    frames, error_px = errors_of({(0, 1): 5.0, (2, 3): np.nan})
    assert misplaced(frames, error_px) == []
    assert misplaced(frames, np.full(len(frames), np.nan)) == []


def test_no_frame_of_a_right_model_is_deregistered() -> None:
    model = synthetic_model()
    assert check_of(model).deregister_misplaced(model) == [] and model.num_reg_images() == 6


def test_a_frame_that_adjustment_brings_back_stays_as_it_is() -> None:
    """Its matches deny its pose as it was mapped; its observations are those of points that others see."""
    model = synthetic_model()
    check = check_of(model)
    frame = model.image(4).frame
    assert frame is not None
    turned = pycolmap.Rotation3d(Rotation.from_rotvec([0, 0.1, 0]).as_quat()) * model.image(4).cam_from_world().rotation
    moved = pycolmap.Rigid3d(turned, model.image(4).cam_from_world().translation)
    frame.set_cam_from_world(model.image(4).camera_id, moved)
    assert check.deregister_misplaced(model) == [] and model.num_reg_images() == 6
    assert np.allclose(model.image(4).cam_from_world().matrix(), moved.matrix())


def test_a_frame_that_sees_points_of_its_own_is_deregistered() -> None:
    """It agrees with one other frame on points that only both see, all scaled about that one's camera; its observations
    of the others' points aren't in the model any more, as outliers."""
    model = synthetic_model()
    check = check_of(model)
    centre = model.image(5).projection_center()
    own = list(model.points3D)[:30]
    for point_id in list(model.points3D):
        track = {e.image_id: e.point2D_idx for e in model.point3D(point_id).track.elements}
        model.delete_observation(4, track[4])
        if point_id in own:
            model.delete_observation(5, track[5])
            seen = pycolmap.Track([pycolmap.TrackElement(number, track[number]) for number in (4, 5)])
            model.add_point3D(centre + 1.5 * (model.point3D(point_id).xyz - centre), seen)
    cam_T_sfm = model.image(4).cam_from_world()
    position = centre + 1.5 * (model.image(4).projection_center() - centre)
    frame = model.image(4).frame
    assert frame is not None
    frame.set_cam_from_world(4, pycolmap.Rigid3d(cam_T_sfm.rotation, -(cam_T_sfm.rotation * position)))
    assert check.deregister_misplaced(model) == [3]
    assert sorted(i - 1 for i in model.reg_image_ids()) == [0, 1, 2, 4, 5]


def check_of(model: pycolmap.Reconstruction) -> MatchCheck:
    keypoints = [np.array([p.xy for p in model.image(row + 1).points2D]) for row in range(6)]
    settings = SfmSettings(lens="stated")
    return MatchCheck(matches_of(model), keypoints, log_of(model, settings), settings)


def matches_of(model: pycolmap.Reconstruction) -> Matches:
    """All pairs of observations of a point."""
    frames, xy_a, xy_b = [], [], []
    for point in model.points3D.values():
        seen = {t.image_id: model.image(t.image_id).point2D(t.point2D_idx).xy for t in point.track.elements}
        for a, b in combinations(sorted(seen), 2):
            frames.append((a - 1, b - 1))
            xy_a.append(seen[a])
            xy_b.append(seen[b])
    return Matches(np.array(frames), np.array(xy_a), np.array(xy_b), np.zeros(len(frames), bool))
