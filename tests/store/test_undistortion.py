"""Images without distortion, against straight lines and OpenCV's."""

from functools import cache

import cv2
import numpy as np
import pytest

from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera, pinhole_within
from groundwalk.store.undistortion import undistorted_image
from tests.geometry.test_cameras import LENSES, SIZE, camera_with

_SPACING = 0.1


@cache
def _grid_photograph(camera: Camera) -> np.ndarray:
    """Bright lines every 0.1 of the plane at unit distance, as the camera sees them, averaged over each pixel."""
    fine = 2
    x, y = ((np.arange(side * fine) + 0.5) / fine for side in SIZE)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    off_line = np.abs((camera.unproject(pixels) / _SPACING + 0.5) % 1 - 0.5) * _SPACING
    bright = np.nan_to_num(np.exp(-((off_line / 0.006) ** 2)).max(axis=1)).reshape(SIZE[1] * fine, SIZE[0] * fine)
    small = cv2.resize(bright, SIZE, interpolation=cv2.INTER_AREA)
    return np.repeat((255 * small).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("lens", LENSES)
def test_the_image_is_opencvs_up_to_interpolation(lens: tuple[float, ...]) -> None:
    camera = camera_with(lens)
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
        undistorted_image(np.zeros((120, 160, 3), np.uint8), camera_with(LENSES[0]), camera_with(()))
