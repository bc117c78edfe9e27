"""Points of one track that were triangulated apart are merged, others aren't."""

import itertools
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from groundwalk.sfm.mapping.merging import merge_points, merged_tracks
from tests.sfm.mapping.test_mappers import synthetic


@pytest.mark.parametrize("wrong", [0, 2000])
def test_pieces_of_tracks_are_merged_however_many_matches_are_wrong(wrong: int) -> None:
    rng, tracks, views = np.random.default_rng(0), 100, 24
    true = rng.uniform(-1, 1, (tracks, 3))
    # Each track in pieces of three views, whose points are off along their rays as those of short tracks are.
    view, track_M = (grid.ravel() for grid in np.meshgrid(np.arange(views), np.arange(tracks)))
    centre = np.column_stack([np.cos(view * 0.3), np.sin(view * 0.3), 0 * view]) * 5
    ray = true[track_M] - centre
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray += rng.normal(0, 3e-4, ray.shape)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    point_M = track_M * (views // 3) + view // 3
    order = rng.permutation(point_M.max() + 1)
    point_M, true_P = order[point_M], np.repeat(np.arange(tracks), views // 3)[np.argsort(order)]
    xyz = true[true_P] + rng.normal(0, 2e-3, (len(true_P), 3))
    one = rng.integers(views, size=(4000, 1)) + views * rng.integers(tracks, size=(4000, 1))
    match = np.hstack([one, one // views * views + rng.integers(views, size=(4000, 1))])
    match = np.concatenate([match, rng.integers(tracks * views, size=(wrong, 2))])
    track_P, found = merged_tracks(xyz, point_M, centre, ray, np.full(len(view), 5e-3), match)
    pairs = np.unique(np.column_stack([track_P, true_P]), axis=0)
    assert len(pairs) == len(found) == tracks
    assert np.abs(found[pairs[:, 0]] - true[pairs[:, 1]]).max() < 5e-3


def test_a_model_whose_tracks_were_torn_has_them_again(tmp_path: Path) -> None:
    given, model = synthetic(tmp_path, 8)
    whole = {_elements(point.track) for point in model.points3D.values()}
    for point_id, point in list(model.points3D.items()):
        elements, xyz = sorted(_elements(point.track)), point.xyz + 1e-4
        model.delete_point3D(point_id)
        for half in (elements[: len(elements) // 2], elements[len(elements) // 2 :]):
            if len(half) > 1:
                model.add_point3D(xyz, pycolmap.Track([pycolmap.TrackElement(*one) for one in half]))
    torn = {_elements(point.track) for point in model.points3D.values()}
    merge_points(model, given.database, 4.0)
    merged = {_elements(point.track) for point in model.points3D.values()}
    assert len(torn & whole) == 0 and len(merged & whole) > 0.9 * len(whole)
    assert all(one.isdisjoint(other) for one, other in itertools.combinations(merged, 2))
    assert all(model.image(i).point2D(k).has_point3D() for elements in merged for i, k in elements)


def _elements(track: pycolmap.Track) -> frozenset[tuple[int, int]]:
    return frozenset((element.image_id, element.point2D_idx) for element in track.elements)
