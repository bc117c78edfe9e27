"""Images without distortion, against straight lines and OpenCV's."""

from functools import cache

import cv2
import numpy as np
import pytest

from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera, pinhole_within
from groundwalk.store.undistortion import undistorted_image

_LENSES = [(0.092, -0.125, 0.0, 0.0), (0.16, -0.40, 0.0, 0.0), (-0.1, 0.02, 0.002, -0.001), (0.1, -0.15, 0, 0, 0.02)]
_SIZE = (320, 240)
_SPACING = 0.1


def _camera(lens: tuple[float, ...]) -> Camera:
    return Camera(*_SIZE, 241.0, 242.5, 161.7, 117.2, lens)


@cache
def _grid_photograph(camera: Camera) -> np.ndarray:
    """Bright lines every 0.1 of the plane at unit distance, as the camera sees them, averaged over each pixel."""
    fine = 2
    x, y = ((np.arange(side * fine) + 0.5) / fine for side in _SIZE)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    off_line = np.abs((camera.unproject(pixels) / _SPACING + 0.5) % 1 - 0.5) * _SPACING
    bright = np.nan_to_num(np.exp(-((off_line / 0.006) ** 2)).max(axis=1)).reshape(_SIZE[1] * fine, _SIZE[0] * fine)
    small = cv2.resize(bright, _SIZE, interpolation=cv2.INTER_AREA)
    return np.repeat((255 * small).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("lens", _LENSES)
def test_the_image_is_opencvs_up_to_interpolation(lens: tuple[float, ...]) -> None:
    camera = _camera(lens)
    pinhole = pinhole_within(camera)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    image: np.ndarray = cv2.GaussianBlur(_grid_photograph(camera), (0, 0), 3)
    ours = undistorted_image(image, camera, pinhole)[2:-2, 2:-2].astype(int)
    expected, shifted = (
        cv2.undistort(image, camera.matrix - by, np.array(lens), None, pinhole.matrix - half)[2:-2, 2:-2]
        for by in (half, 0 * half)
    )
    assert np.abs(ours - expected).max() <= 3
    assert np.abs(ours - shifted).max() > 6  # half a pixel would show


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(GeometryError, match="160 x 120"):
        undistorted_image(np.zeros((120, 160, 3), np.uint8), _camera(_LENSES[0]), _camera(()))
