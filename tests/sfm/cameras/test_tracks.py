"""A large model is adjusted by some of its tracks, and the other points follow."""

from dataclasses import replace

import numpy as np
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.sfm.cameras import model_adjustment, tracks
from groundwalk.sfm.cameras.model_adjustment import adjust_model
from groundwalk.sfm.cameras.tracks import chosen_tracks, of_points, triangulated
from groundwalk.sfm.database import pose_of
from groundwalk.sfm.settings import SfmSettings
from tests.sfm.cameras.test_adjustment import walk_of
from tests.sfm.synthetic_model import log_of, synthetic_model


def test_some_points_are_chosen_and_enough_for_each_part_of_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    bundle, cameras = walk_of(0)
    monkeypatch.setattr(tracks, "_POINTS_PER_FRAME", 0)
    monkeypatch.setattr(tracks, "_TRACKS_PER_PART", 2)
    kept = chosen_tracks(bundle, cameras)
    assert kept.mean() < 0.7
    part = (bundle.observed_px // [160, 118]).astype(int).clip(0, 3)
    for frame in range(len(bundle.sfm_T_cam)):
        for column, row in np.ndindex(4, 4):
            is_there = (bundle.frame == frame) & (part == [column, row]).all(axis=1)
            assert kept[bundle.point[is_there]].sum() >= min(2, is_there.sum())
    monkeypatch.setattr(tracks, "_POINTS_PER_FRAME", 18)
    assert 18 * len(bundle.sfm_T_cam) <= chosen_tracks(bundle, cameras).sum() < len(bundle.xyz)


def test_points_that_were_moved_go_back_to_where_their_observations_have_them() -> None:
    bundle, cameras = walk_of(1)
    rng = np.random.default_rng(1)
    held = replace(bundle, held_points=np.array([3]))
    moved = replace(held, xyz=bundle.xyz + 0.2 * rng.normal(size=bundle.xyz.shape))
    found = triangulated(moved, cameras, 0.1)
    assert np.abs(np.delete(found - bundle.xyz, 3, axis=0)).max() < 1e-6
    assert (found[3] == moved.xyz[3]).all()
    noisy = replace(moved, observed_px=bundle.observed_px + 0.2 * rng.normal(size=bundle.observed_px.shape))
    outlier = int(np.flatnonzero(np.bincount(bundle.point) > 8)[0])
    noisy.observed_px[np.flatnonzero(bundle.point == outlier)[0]] += 40
    without = of_points(noisy, np.arange(len(bundle.xyz)) == outlier)
    without = replace(without, frame=without.frame[1:], point=without.point[1:], observed_px=without.observed_px[1:])
    found = triangulated(noisy, cameras, 0.5)
    assert np.median(np.linalg.norm(found - bundle.xyz, axis=1)) < 0.01
    assert np.abs(found[outlier] - triangulated(without, cameras, 0.5)).max() < 0.01


def test_a_bundle_of_some_points_has_all_frames_and_what_they_see_of_these() -> None:
    bundle, _ = walk_of(2)
    kept = np.arange(len(bundle.xyz)) % 3 == 0
    few = of_points(replace(bundle, held_points=np.array([3, 4, 6])), kept)
    assert (few.xyz == bundle.xyz[kept]).all() and len(few.sfm_T_cam) == len(bundle.sfm_T_cam)
    assert few.held_points.tolist() == [1, 2]
    assert (few.observed_px == bundle.observed_px[kept[bundle.point]]).all()
    assert (np.flatnonzero(kept)[few.point] == bundle.point[kept[bundle.point]]).all()


def test_a_large_model_comes_out_as_a_small_one_with_all_its_points(monkeypatch: pytest.MonkeyPatch) -> None:
    def adjusted(is_large: bool) -> tuple[np.ndarray, dict[int, np.ndarray], int]:
        model = synthetic_model()
        keypoints = [np.array([p.xy for p in model.image(row + 1).points2D]) for row in range(6)]
        with monkeypatch.context() as patch:
            patch.setattr(model_adjustment, "is_large", lambda frames: is_large)
            patch.setattr(tracks, "_TRACKS_PER_PART", 1)
            patch.setattr(tracks, "_POINTS_PER_FRAME", 0)
            one, rows = adjust_model(model, keypoints, log_of(model), SfmSettings(refine_cameras="never"))
        poses = np.stack([pose_of(model.image(row + 1)) for row in rows])
        return poses, {i: point.xyz for i, point in model.points3D.items()}, len(one.bundle.xyz)

    (small_T, small, all_points), (large_T, large, few_points) = adjusted(False), adjusted(True)
    assert few_points < all_points == len(small) and small.keys() == large.keys()
    points, others = np.array([*small.values()]), np.array([large[i] for i in small])
    fit = fit_sim3(points, others)
    assert np.abs(fit.points(others) - points).max() < 2e-3 and np.abs(fit.poses(large_T) - small_T).max() < 5e-3
