"""Adjusted models: what is taken out, deregistered, held out or misplaced, and what isn't determined."""

from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.linalg import LinAlgError

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.model_adjustment import adjust_model, cameras_of_frames
from groundwalk.sfm.database import pose_of
from groundwalk.sfm.mapping.held_out import Matches, choose_held_out, held_out_check
from groundwalk.sfm.mapping.misplaced import misplaced_frames
from groundwalk.sfm.model import BuiltModel, load_models
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.tables import camera_tables
from groundwalk.store.choices import CameraOrigin
from tests.sfm.synthetic_model import log_of, synthetic_model


def test_points_behind_a_camera_are_taken_out(tmp_path: Path) -> None:
    model = synthetic_model()
    behind, image_id = next((p, t.image_id) for p, point in model.points3D.items() for t in point.track.elements)
    centre = model.image(image_id).projection_center()
    model.point3D(behind).xyz = 2 * centre - model.point3D(behind).xyz

    model.write_binary(tmp_path)
    adjusted, rows = adjust_model(model, _keypoints(model), log_of(model), SfmSettings(refine_cameras="never"))

    model.write_binary(tmp_path)
    left = load_models([tmp_path], 6)
    assert rows.tolist() == list(range(6)) and np.isfinite(adjusted.loss_px)
    assert np.isfinite(left.residual_px).all() and np.isfinite(left.point_error_px()).all()
    assert left.registered.all() and len(left.xyz) >= 59


def test_a_frame_with_hardly_an_observation_is_deregistered() -> None:
    model = synthetic_model()
    _leave(model, 6, 5)
    adjusted, rows = adjust_model(model, _keypoints(model), log_of(model), SfmSettings())
    assert rows.tolist() == list(range(5)) == [frame_id - 1 for frame_id in sorted(model.reg_frame_ids())]
    assert len(adjusted.bundle.sfm_T_cam) == 5 and np.isfinite(adjusted.bundle.sfm_T_cam).all()


def test_a_model_of_a_handful_of_observations_is_not_determined() -> None:
    model = synthetic_model()
    for image_id in range(1, 7):
        _leave(model, image_id, 5)
    with pytest.raises(LinAlgError, match="hardly any frame"):
        adjust_model(model, _keypoints(model), log_of(model), SfmSettings())


def test_cameras_of_a_model_without_covariances_have_no_sigma() -> None:
    model = synthetic_model()
    log = log_of(model)
    adjusted = adjust_model(model, _keypoints(model), log, SfmSettings())
    lenses, sessions = camera_tables(
        log, [CameraOrigin.STATED] * 6, [BuiltModel.of("incremental", 0, model)], [adjusted], [None]
    )
    assert lenses[["k1_sd", "k2_sd", "k3_sd", "readout_sd_s"]].isna().all(axis=None)
    assert sessions["focal_scale_sd"].isna().all() and sessions["session_id"].tolist() == ["walk"]
    assert lenses["frames"].tolist() == sessions["frames"].tolist() == [6]


def _leave(model: pycolmap.Reconstruction, image_id: int, count: int) -> None:
    """Take all but some of an image's observations away."""
    observations = pycolmap.ObservationManager(model)
    seen = [i for i, point in enumerate(model.image(image_id).points2D) if point.has_point3D()]
    for index in seen[count:]:
        if model.image(image_id).point2D(index).has_point3D():
            observations.delete_observation(image_id, index)


def _keypoints(model: pycolmap.Reconstruction) -> list[Array]:
    return [np.array([p.xy for p in model.image(row + 1).points2D]) for row in range(6)]


def test_whole_tracks_are_left_out_and_about_the_share_of_them() -> None:
    # Feature k of each of three frames is one track, matched in a triangle.
    tracks = 4000
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    pair = np.repeat([0, 1, 2], tracks)
    matches = np.tile(np.arange(tracks)[:, None], (3, 2))
    out = choose_held_out(pair, matches, pairs, np.full(3, tracks), 0.05, 0).reshape(3, tracks)
    assert (out[0] == out[1]).all()
    assert (out[0] == out[2]).all()
    assert out[0].mean() == pytest.approx(0.05, abs=0.015)


def test_a_track_with_two_features_of_a_frame_is_never_left_out() -> None:
    # Features 0 and 1 of frame 0 both match feature 0 of frame 1.
    out = choose_held_out(
        np.zeros(3, int), np.array([[0, 0], [1, 0], [2, 2]]), np.array([[0, 1]]), np.full(2, 3), 1.0, 0
    )
    assert out.tolist() == [False, False, True]


def test_errors_of_matches_do_not_hang_on_how_many_are_worked_out_together(monkeypatch: pytest.MonkeyPatch) -> None:
    model, rng = synthetic_model(), np.random.default_rng(0)
    log = log_of(model)
    cameras = cameras_of_frames(log, [adjust_model(model, _keypoints(model), log, SfmSettings())])
    poses = np.stack([pose_of(model.image(row + 1)) for row in range(6)])
    frames = np.sort(rng.permuted(np.tile(np.arange(6), (100, 1)), axis=1)[:, :2], axis=1)
    xy_a, xy_b = rng.uniform(0, 400, (2, 100, 2))
    matches = Matches(frames, xy_a, xy_b, rng.random(100) < 0.1)
    of_model = np.array([0, 0, 0, 0, 0, -1])
    together = held_out_check(matches, cameras, poses, of_model)
    monkeypatch.setattr("groundwalk.sfm.mapping.held_out._AT_ONCE", 7)
    pd.testing.assert_frame_equal(held_out_check(matches, cameras, poses, of_model), together, rtol=1e-12)
    assert (
        len(together) == (frames != 5).all(axis=1).sum()
        and (together["a"] == frames[(frames != 5).all(axis=1), 0]).all()
    )


PAIRS = np.array(list(combinations(range(9), 2)))


def check_of(wrong: dict[tuple[int, int], float]) -> pd.DataFrame:
    """Ten matches of each pair of nine frames, off by 0.1 px or as stated of pairs."""
    a, b = np.repeat(PAIRS, 10, axis=0).T
    errors = [wrong.get(pair, 0.1) for pair in zip(a.tolist(), b.tolist(), strict=True)]
    return pd.DataFrame({"a": a, "b": b, "error_px": errors})


@pytest.mark.parametrize(
    ("is_wrong", "off_px", "rows"),
    [
        (lambda a, b: 2 in (a, b), 5.0, [2]),  # contradicted by all others
        (lambda a, b: (a in (4, 5)) != (b in (4, 5)), 5.0, [4, 5]),  # two that agree with each other alone
        (lambda a, b: 2 in (a, b), 0.5, [2]),  # the limit follows the errors of the other pairs
        (lambda a, b: 2 in (a, b), 0.35, []),
        (lambda a, b: (a, b) == (0, 1), 5.0, []),  # one wrong pair of many
        (lambda a, b: True, 3.0, []),  # all are off
    ],
)
def test_frames_that_most_of_their_matches_contradict(
    is_wrong: Callable[[int, int], bool], off_px: float, rows: list[int]
) -> None:
    check = check_of({(a, b): off_px for a, b in PAIRS.tolist() if is_wrong(a, b)})
    assert sorted(misplaced_frames(check)) == rows
    assert misplaced_frames(check[:0]) == []
