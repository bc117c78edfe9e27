"""Frames whose verified matches deny their poses are taken out of a model; no others are."""

from itertools import combinations

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from synthetic_model import log_of, synthetic_model

from groundwalk.sfm.cameras.model_adjustment import cameras_of_frames
from groundwalk.sfm.mapping.misplaced import MatchCheck, misplaced
from groundwalk.sfm.mapping.source import Matches

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


@pytest.mark.parametrize("moved", [None, 3])
def test_a_moved_frame_is_deregistered_with_what_only_it_saw(moved: int | None) -> None:
    model = synthetic_model()
    check = MatchCheck(matches_of(model), cameras_of_frames(log_of(model), []))
    if moved is not None:
        image = model.image(moved + 1)
        cam_T_sfm = image.cam_from_world()
        assert image.frame is not None
        turned = pycolmap.Rotation3d(Rotation.from_rotvec([0, 0.1, 0]).as_quat()) * cam_T_sfm.rotation
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(turned, cam_T_sfm.translation))
    assert check.deregister_misplaced(model) == (0 if moved is None else 1)
    assert sorted(i - 1 for i in model.reg_image_ids()) == [row for row in range(6) if row != moved]


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
