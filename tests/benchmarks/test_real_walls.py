"""Directions of walls in drawn images of a room."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.real_walls import direction_of_walls
from groundwalk.geometry.lens import distort
from groundwalk.geometry.poses import Array

FOCAL, CENTRE, LENS = 600.0, np.array([480.0, 360.0]), np.array([0.09, -0.12, 0.0, 0.0])


def image(upright_R_cam: Array, walls_deg: float) -> np.ndarray:
    """Edges of a corridor along `walls_deg` about y: floor, ceiling, and door frames across it."""
    along = np.array([np.sin(np.radians(walls_deg)), 0.0, np.cos(np.radians(walls_deg))])
    across, up = np.array([along[2], 0.0, -along[0]]), np.array([0.0, 1.0, 0.0])
    lines = [(x * across + y * up, along) for x in (-1.2, 1.2) for y in (-1.5, 1.1)]
    lines += [(z * along + 1.1 * up, across) for z in np.arange(-12, 12, 1.5)]
    drawn = np.full((720, 960), 230, np.uint8)
    for start, direction in lines:
        points = (start + np.linspace(-30, 30, 4001)[:, None] * direction) @ upright_R_cam
        if direction is across:
            points = (start + np.linspace(-1.2, 1.2, 400)[:, None] * direction) @ upright_R_cam
        ideal = points[points[:, 2] > 0.3]
        ideal = ideal[:, :2] / ideal[:, 2:]
        seen = ideal[np.linalg.norm(ideal, axis=1) < 1.0]  # farther out the lens's polynomial folds
        px = distort(seen, LENS) * FOCAL + CENTRE
        cv2.polylines(drawn, [np.rint(16 * (px - 0.5)).astype(np.int32)], False, 60, 3, cv2.LINE_AA, 4)
    return drawn


@pytest.mark.parametrize("heading_deg", [0.0, 12.0, 37.0, 95.0])
def test_walls_lie_where_they_are_whichever_way_the_camera_looks(heading_deg: float) -> None:
    flip = np.diag([1.0, -1.0, -1.0])  # cameras have y down and z ahead
    upright_R_cam = Rotation.from_euler("YX", [heading_deg, -12.0], degrees=True).as_matrix() @ flip
    walls_deg = 21.0
    intrinsics = np.array([FOCAL, FOCAL, *CENTRE])
    found = direction_of_walls(image(upright_R_cam, walls_deg), intrinsics, LENS, upright_R_cam)
    assert abs((found - walls_deg + 45) % 90 - 45) < 0.5
