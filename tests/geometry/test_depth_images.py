"""Depth at places of an image, and medians of ratios, on images whose depth is known."""

import numpy as np

from groundwalk.geometry.depth_images import sample_depth, smooth_pixels

SIZE = (640, 480)


def plane(shape: tuple[int, int] = (48, 64)) -> np.ndarray:
    """Depth that is linear over the image: 1 m at its left border, 1.5 m at its right one."""
    return np.tile(1 + 0.5 * (np.arange(shape[1]) + 0.5) / shape[1], (shape[0], 1))


def test_depth_is_read_where_the_image_has_it() -> None:
    xy = np.random.default_rng(0).uniform([10, 10], [630, 470], (200, 2))
    found, nearest = sample_depth(plane(), xy, SIZE)
    np.testing.assert_allclose(found, 1 + 0.5 * xy[:, 0] / 640, atol=1e-12)
    np.testing.assert_array_equal(nearest, np.floor(xy[:, ::-1] / 10))


def test_nothing_is_read_at_edges_holes_or_outside() -> None:
    depth = plane()
    depth[:, 32:] += 1.0  # an edge between columns 31 and 32
    depth[20, 10] = 0.0
    xy = np.array(
        [[100.0, 100], [318, 100], [325, 100], [345, 100], [95, 195], [115, 205], [135, 205], [-1, 5], [5, 481]]
    )
    found, _ = sample_depth(depth, xy, SIZE)
    assert np.isfinite(found).tolist() == [True, False, False, True, False, False, True, False, False]
    assert not smooth_pixels(depth)[19:22, 9:12].any()
