from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from artefacts import UserError
from training.data import ImageCache, Jitter, read_image, shift_hue, turned_crop

K = np.array([[80.0, 0, 47.3], [0, 80.0, 36.9], [0, 0, 1]])


def test_a_turned_crop_is_what_the_turned_camera_sees() -> None:
    """A spot in a known direction lies where the turned camera projects that direction."""
    spot = np.array([0.12, -0.08, 1.0])
    u, v, _ = K @ spot
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
    blob = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.5**2))
    image = np.repeat(blob[..., None], 3, axis=2).astype(np.uint8)
    cam_R_turned = Rotation.from_euler("yxz", [6, -3, 5], degrees=True).as_matrix()
    seen = turned_crop(image, K, cam_R_turned, 64)[..., 0].astype(float)
    px, py = (np.arange(64) + 0.5) @ seen.sum(0) / seen.sum(), (np.arange(64) + 0.5) @ seen.sum(1) / seen.sum()
    ray = K @ cam_R_turned.T @ spot
    expected = ray[:2] / ray[2] - [16, 4]
    assert [px, py] == pytest.approx(expected, abs=0.15)
    straight = turned_crop(image, K, np.eye(3), 64)
    assert np.array_equal(straight, image[4:68, 16:80])


def test_images_are_cached_once_and_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    paths = []
    for i, shape in enumerate([(90, 120, 3), (160, 100, 3)]):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), rng.integers(0, 255, shape, dtype=np.uint8))
    cache = ImageCache.build(tmp_path / "cache", paths, 45)
    assert [cache[0].shape, cache[1].shape] == [(45, 60, 3), (72, 45, 3)]
    assert np.array_equal(cache[1], read_image(paths[1], 45))
    paths[0].unlink()
    assert np.array_equal(ImageCache.build(tmp_path / "cache", paths, 45)[0], cache[0])


def test_an_image_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"gone\.jpg[\s\S]*no such file"):
        ImageCache.build(tmp_path / "cache", [tmp_path / "gone.jpg"], 32)
    (tmp_path / "text.jpg").write_text("no image")
    with pytest.raises(UserError, match="isn't an image"):
        ImageCache.build(tmp_path / "cache", [tmp_path / "text.jpg"], 32)


def test_hue_moves_around_the_colour_circle() -> None:
    image = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    third = torch.full((2, 1, 1, 1), 1 / 3)
    assert torch.allclose(shift_hue(image, third), image[:, [2, 0, 1]], atol=1e-5)
    assert torch.allclose(shift_hue(image, 3 * third), image, atol=1e-5)


def test_jitter_stays_in_range_and_repeats() -> None:
    image = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    first, second = (Jitter(0.5, 0.5, 0.5, 0.2).apply(image, np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.allclose(first, image, atol=0.05)
    assert float(first.min()) >= 0 and float(first.max()) <= 1
    assert torch.equal(Jitter(0, 0, 0, 0).apply(image, np.random.default_rng(1)), image)
