"""The held-out check: whole tracks, the asked share, and an error that tells right poses from wrong ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geometry.poses import inverse, make_pose, transform
from sfm.held_out import choose_held_out, sampson_px

_FOCAL_PX = 500.0


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
    assert not choose_held_out(pair, matches, pairs, np.full(3, tracks), 0.0, 0).any()


def test_a_track_with_two_features_of_a_frame_is_never_left_out() -> None:
    # Features 0 and 1 of frame 0 both match feature 0 of frame 1.
    out = choose_held_out(
        np.zeros(3, int), np.array([[0, 0], [1, 0], [2, 2]]), np.array([[0, 1]]), np.full(2, 3), 1.0, 0
    )
    assert out.tolist() == [False, False, True]


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_the_error_is_the_distance_from_the_epipolar_constraint_in_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_T_b = make_pose(Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix(), rng.uniform(-1, 1, 3))
    points_a = rng.uniform([-1, -1, 3], [1, 1, 8], (40, 3))
    points_b = transform(inverse(a_T_b), points_a)
    ray_a, ray_b = points_a / points_a[:, 2:], points_b / points_b[:, 2:]
    focal = np.full(40, _FOCAL_PX)
    many = np.tile(a_T_b, (40, 1, 1))
    assert sampson_px(many, ray_a, ray_b, focal, focal).max() < 1e-6
    # To first order no movement of a match by e pixels in all is farther than e from the constraint.
    shift = rng.normal(size=(40, 4))
    shift *= 0.1 / np.linalg.norm(shift, axis=1, keepdims=True)
    moved_a, moved_b = ray_a.copy(), ray_b.copy()
    moved_a[:, :2] += shift[:, :2] / _FOCAL_PX
    moved_b[:, :2] += shift[:, 2:] / _FOCAL_PX
    found = sampson_px(many, moved_a, moved_b, focal, focal)
    assert found.max() < 0.101
    assert found.max() > 0.02
    # Any scale of the translation is the same constraint.
    many[:, :3, 3] *= 7.0
    assert sampson_px(many, moved_a, moved_b, focal, focal) == pytest.approx(found)
