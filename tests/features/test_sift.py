"""SIFT: where features lie, how they are chosen, and what describes them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import DESCRIPTOR_SIZE, even_sift, sift

WIDTH, HEIGHT = 640, 480
BLOBS = np.array([[120.5, 90.25], [420.0, 300.75], [533.25, 131.5], [240.75, 400.5]])


def blobs(factor: float = 1.0) -> NDArray[np.uint8]:
    """Round blobs whose centres are BLOBS, in pixels with the first one's centre at 0.5; the image is `factor` times as
    large."""
    y, x = (np.mgrid[: round(HEIGHT * factor), : round(WIDTH * factor)] + 0.5) / factor
    grey = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 6.0**2)) for cx, cy in BLOBS)
    return np.clip(60 + 150 * grey, 0, 255).astype(np.uint8)


def half_textured() -> NDArray[np.uint8]:
    """Strong texture in the left half, faint texture in the right."""
    rng = np.random.default_rng(0)
    grey = cv2.resize(rng.normal(size=(HEIGHT // 6, WIDTH // 6)), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    strength = np.where(np.arange(WIDTH) < WIDTH // 2, 40.0, 10.0)
    return np.clip(128 + strength * grey, 0, 255).astype(np.uint8)


def test_the_first_pixel_s_centre_is_at_a_half() -> None:
    for factor in (1.0, 2.5):  # at 2.5 the image is shrunk first
        px = even_sift(blobs(factor), 100, WIDTH, 0.04).px / factor
        distance = np.linalg.norm(px[:, None] - BLOBS, axis=2).min(axis=0)
        assert (distance < 0.1).all()


def test_even_features_reach_where_texture_is_faint() -> None:
    image = half_textured()
    even, strong = even_sift(image, 300, WIDTH, 0.01), sift(image, 300, WIDTH)
    in_the_right_half = [np.mean(one.px[:, 0] > WIDTH / 2) for one in (even, strong)]
    assert len(even) == len(strong) == 300
    assert in_the_right_half[0] > 0.4
    assert in_the_right_half[1] < 0.1


def test_descriptors_have_one_length() -> None:
    features = even_sift(half_textured(), 200, WIDTH, 0.04)
    assert features.descriptors.dtype == np.uint8
    np.testing.assert_allclose(np.linalg.norm(features.descriptors.astype(float), axis=1), 512, rtol=0.02)


def test_a_blank_image_has_no_features() -> None:
    blank = np.full((HEIGHT, WIDTH), 128, np.uint8)
    for features in (sift(blank, 100, WIDTH), even_sift(blank, 100, WIDTH, 0.04)):
        assert features.px.shape == (0, 2)
        assert features.descriptors.shape == (0, DESCRIPTOR_SIZE)
