"""Bands of a drawn floor are found where they lie, and show where the scale of a walk drifts."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.real_floor import floor_bands, spacings, straight_legs
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array, make_pose

WIDTH, HEIGHT, FOCAL, HAND_M = 480, 360, 380.0, 1.5
LENS = np.array([0.09, -0.12, 0.0, 0.0])
BANDS_M = np.arange(1.0, 14.0, 1.9)
# Cameras have y down and z ahead; looking down by 20 degrees, along +z of the map.
LOOK = Rotation.from_euler("x", 20, degrees=True).as_matrix() @ np.diag([-1.0, -1.0, 1.0])


def image(map_T_cam: Array) -> np.ndarray:
    """Grey tiles with dark bands across, 12 cm wide, drawn a ray a pixel."""
    px = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1).reshape(-1, 2)
    ideal = undistort((px - [WIDTH / 2, HEIGHT / 2]) / FOCAL, LENS)
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ map_T_cam[:3, :3].T
    below = rays[:, 1] < -0.05
    z = map_T_cam[2, 3] - rays[:, 2] / np.where(below, rays[:, 1], -1) * (map_T_cam[1, 3] + HAND_M)
    dark = np.abs(z[:, None] - BANDS_M).min(axis=1) < 0.06
    return np.where(below & dark, 90, 180).astype(np.uint8).reshape(HEIGHT, WIDTH)


def bands_by(walked_m: Array, factor: Array) -> Array:
    """The bands by poses whose steps are too long by a factor each."""
    true = make_pose(LOOK, np.column_stack([0 * walked_m, 0 * walked_m, walked_m]))
    said = true.copy()
    said[:, 2, 3] = np.concatenate([[0], np.cumsum(np.diff(walked_m) * factor)])
    intrinsics = np.tile([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], (len(true), 1))
    return floor_bands(lambda row: image(true[row]), intrinsics, [LENS] * len(true), said, -HAND_M)


def test_bands_lie_where_they_are() -> None:
    walked_m = np.arange(0, 10, 0.5)
    # The walk begins at its first frame, as both do.
    found = bands_by(walked_m, np.ones(len(walked_m) - 1))
    assert found == pytest.approx(BANDS_M[(BANDS_M > 1.7) & (BANDS_M < 13)], abs=0.02)


def test_a_scale_that_drifts_shows_in_their_spacing() -> None:
    walked_m = np.arange(0, 10, 0.5)
    apart = spacings(bands_by(walked_m, np.where(walked_m[1:] > 5, 1.04, 1.0)))
    assert apart[0] == pytest.approx(1.9, abs=0.02) and apart[-1] == pytest.approx(1.04 * 1.9, abs=0.03)


def test_spacings_are_of_neighbours_alone() -> None:
    assert spacings(np.array([0.0, 2.0, 4.0, 8.0, 10.0, 11.0])) == pytest.approx([2.0, 2.0, 2.0])
    assert not len(spacings(np.array([3.0])))


def test_a_walk_round_a_corner_has_two_straight_legs() -> None:
    there = np.column_stack([np.zeros(40), np.zeros(40), 0.5 * np.arange(40)])
    back = np.column_stack([0.5 * np.arange(1, 30), np.zeros(29), np.full(29, 19.5)])
    short = np.column_stack([np.full(8, 14.5), np.zeros(8), 19.5 - 0.5 * np.arange(1, 9)])
    first, second = straight_legs(np.concatenate([there, back, short]))
    assert first[0] == 0 and 37 <= first[-1] <= 41
    assert 38 <= second[0] <= 42 and 66 <= second[-1] <= 70
