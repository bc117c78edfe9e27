"""When the pixels of an image are exposed."""

import cv2
import numpy as np
import pytest

from groundwalk.geometry.shutter import readout_fraction, readout_lines, turned_side

WIDTH, HEIGHT = 64, 48


TURNS = {"right": cv2.ROTATE_90_CLOCKWISE, "bottom": cv2.ROTATE_180, "left": cv2.ROTATE_90_COUNTERCLOCKWISE}


@pytest.mark.parametrize("side", ["top", *TURNS])
def test_a_turned_image_is_exposed_as_its_sensor_was(side: str) -> None:
    turn, share = TURNS.get(side), np.tile((np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT - 0.5, (1, WIDTH))
    image = share if turn is None else cv2.rotate(share, turn)
    height, width = image.shape
    (line,) = readout_lines([turned_side("top", ["top", *TURNS].index(side))], width, height)
    x, y = (index.ravel() + 0.5 for index in np.meshgrid(np.arange(width), np.arange(height)))
    assert np.allclose(readout_fraction(line, np.column_stack([x, y])), image.ravel())
