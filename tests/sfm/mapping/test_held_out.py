"""The held-out check: whole tracks, and the asked share of them."""

import numpy as np
import pytest

from groundwalk.sfm.mapping.held_out import choose_held_out


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
