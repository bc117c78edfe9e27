"""Tracks and points of frames with known poses: against true points and OpenCV's triangulation."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import inverse
from groundwalk.localisation.build import covering_points
from groundwalk.localisation.frames import rays_of
from groundwalk.localisation.localisers import StructureSettings
from groundwalk.localisation.matching import covisible_pairs
from groundwalk.localisation.prepared import prepare
from groundwalk.localisation.tracks import Rays, epipolar_error_px, tracks, triangulate
from tests.localisation.scenes import HIGH, SEEN_BY, place, projected, training, walk


@pytest.mark.parametrize("first_row", ["top", "right", "bottom", "left"])
@pytest.mark.parametrize("camera", [SEEN_BY, HIGH], ids=["wide", "high"])
def test_rays_of_a_rolling_shutter_go_through_the_points(camera: Camera, first_row: str) -> None:
    views, xyz = walk(4, camera=replace(camera, first_row=first_row)), place().xyz
    px = projected(views, 2, xyz)
    seen = np.isfinite(px).all(axis=1)
    origin, direction = rays_of(views, 2, px[seen])
    along = xyz[seen] - origin
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    miss = np.linalg.norm(along - np.sum(along * unit, axis=1)[:, None] * unit, axis=1)
    assert np.median(480 * miss / np.linalg.norm(along, axis=1)) < 0.05  # px


def test_points_are_opencvs_and_the_true_ones() -> None:
    views, xyz = walk(2, moving=False, reach_m=1), place().xyz
    px = np.stack([projected(views, view, xyz) for view in range(2)])
    seen = np.isfinite(px).all(axis=(0, 2))
    px, xyz, count = px[:, seen], xyz[seen], int(seen.sum())
    origin, direction = map(np.concatenate, zip(*(rays_of(views, view, px[view]) for view in range(2)), strict=True))
    every = Rays(origin, direction, np.full(2 * count, 480.0), np.repeat([0, 1], count))
    first = np.arange(count)
    assert epipolar_error_px(every[first], every[count + first]).max() < 1e-6
    points = triangulate(every, *tracks(np.stack([first, count + first], axis=1), every.view), 2.0, 0.1)
    ideal = [views.cameras[0].unproject(p).T for p in px]
    homogeneous = cv2.triangulatePoints(*(inverse(pose)[:3] for pose in views.map_T_cam), *ideal)
    np.testing.assert_allclose(points.xyz, (homogeneous[:3] / homogeneous[3]).T, atol=1e-5)
    np.testing.assert_allclose(points.xyz, xyz, atol=1e-5)


def test_a_wrong_observation_is_left_out_and_a_lonely_point_dropped() -> None:
    views, xyz = walk(5, moving=False, reach_m=1), place().xyz
    px = np.stack([projected(views, view, xyz) for view in range(5)])
    point = int(np.flatnonzero(np.isfinite(px).all(axis=(0, 2)))[0])
    at = px[:, point].copy()
    at[2] += 25
    parts = (rays_of(views, view, at[view : view + 1]) for view in range(5))
    origin, direction = map(np.concatenate, zip(*parts, strict=True))
    every = Rays(origin, direction, np.full(5, 480.0), np.arange(5))
    points = triangulate(every, np.zeros(5, np.int64), np.arange(5), 2.0, 0.1)
    assert points.feature.tolist() == [0, 1, 3, 4]
    np.testing.assert_allclose(points.xyz, xyz[[point]], atol=1e-6)
    two = triangulate(every, np.zeros(2, np.int64), np.array([1, 2]), 2.0, 0.1)
    assert len(two.xyz) == 0 and len(two.point) == 0


def test_pairs_are_of_frames_that_see_the_same() -> None:
    views = walk(9, moving=False)
    turned = views.map_T_cam.copy()
    turned[8] = turned[8] @ np.diag([-1.0, 1, -1, 1])
    pairs = covisible_pairs(turned, np.full((9, 2), 0.6), 6.0, 2)
    assert not (pairs == 8).any()
    assert len(pairs) <= 18 and (np.abs(np.diff(pairs, axis=1)) <= 2).all()


def test_structure_is_of_true_points() -> None:
    scene = place()
    prepared = prepare("room", training(scene, walk(10)), StructureSettings())
    away = cKDTree(scene.xyz).query(prepared.points.xyz)[0]
    assert len(away) > 400 and np.median(away) < 0.02 and np.quantile(away, 0.99) < 0.3
    fewer = prepared.points_of(np.arange(10) != 4)
    assert len(fewer.xyz) > 400 and not (prepared.rays.view[fewer.feature] == 4).any()


def test_selection_covers_cells_before_it_repeats_them() -> None:
    # Ten points in one cell, one in each of four others.
    point = np.arange(14)
    cell = np.r_[np.zeros(10, int), 1, 2, 3, 4]
    chosen = covering_points(point, cell, np.ones(14), 5)
    assert set(range(10, 14)) <= set(chosen.tolist())
    assert covering_points(point, cell, np.ones(14), 20).tolist() == list(range(14))
