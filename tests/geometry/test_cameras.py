"""Cameras with lenses, against COLMAP's, and the pinholes within them."""

import numpy as np
import pycolmap
import pytest

from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera, centred_pinhole, pinhole_within
from tests.known import there

LENSES = [(0.092, -0.125, 0.0, 0.0), (0.16, -0.40, 0.0, 0.0), (-0.1, 0.02, 0.002, -0.001), (0.1, -0.15, 0, 0, 0.02)]
SIZE = (320, 240)


def camera_with(lens: tuple[float, ...]) -> Camera:
    return Camera(*SIZE, 241.0, 242.5, 161.7, 117.2, lens)


def test_a_camera_projects_as_colmaps_does() -> None:
    camera, points = camera_with(LENSES[2]), np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    theirs = pycolmap.Camera(
        camera_id=1, model="OPENCV", width=320, height=240, params=[241.0, 242.5, 161.7, 117.2, *LENSES[2]]
    )
    px = camera.project(points)
    assert np.allclose(px, there(theirs.img_from_cam(np.column_stack([points, np.ones(50)]))), atol=1e-9)
    assert np.allclose(camera.unproject(px), points, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_a_pinhole_within_has_no_border_and_hardly_any_room_left(lens: tuple[float, ...]) -> None:
    camera = camera_with(lens)
    pinhole = pinhole_within(camera)
    edge = np.linspace(0, 1, 50)
    border = np.concatenate([[(0, t), (1, t), (t, 0), (t, 1)] for t in edge]) * SIZE
    inside = camera.project(pinhole.unproject(border))
    assert (inside > -0.01).all() and (inside < np.array(SIZE) + 0.01).all()
    wider = centred_pinhole(*SIZE, 0.98 * pinhole.fx)
    outside = camera.project(wider.unproject(border))
    assert (outside < 0).any() or (outside > SIZE).any()


def test_what_has_no_pinhole_is_said() -> None:
    with pytest.raises(GeometryError, match="no pinhole"):
        pinhole_within(camera_with((-300.0, 0.0, 0.0, 0.0)))
    with pytest.raises(GeometryError, match="no pinhole"):
        pinhole_within(Camera(*SIZE, 240.0, 240.0, -3.0, 120.0))
