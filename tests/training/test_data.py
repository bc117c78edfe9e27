from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation

from groundwalk.geometry.cameras import Camera
from groundwalk.store.images import read_image
from groundwalk.store.resizing import pinhole_image, small_image, turned_crop
from groundwalk.store.tables import pose_frame
from groundwalk.training.data import ImageCache, jittered, shift_hue
from groundwalk.training.inputs import as_training_frames, virtual_focal

K = np.array([[80.0, 0, 47.3], [0, 80.0, 36.9], [0, 0, 1]])


def test_a_turned_crop_is_what_the_turned_camera_sees() -> None:
    """A spot in a known direction lies where the turned camera projects that direction."""
    spot = np.array([0.12, -0.08, 1.0])
    u, v, _ = K @ spot
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
    blob = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 1.5**2))
    image = np.repeat(blob[..., None], 3, axis=2).astype(np.uint8)
    cam_R_turned = Rotation.from_euler("yxz", [6, -3, 5], degrees=True).as_matrix()
    seen = turned_crop(image, K, cam_R_turned, 64, 64)[..., 0].astype(float)
    px, py = (np.arange(64) + 0.5) @ seen.sum(0) / seen.sum(), (np.arange(64) + 0.5) @ seen.sum(1) / seen.sum()
    ray = K @ cam_R_turned.T @ spot
    expected = ray[:2] / ray[2] - [16, 4]
    assert [px, py] == pytest.approx(expected, abs=0.15)
    straight = turned_crop(image, K, np.eye(3), 64, 64)
    assert np.array_equal(straight, image[4:68, 16:80])


def test_images_are_cached_once_and_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    paths = []
    for i, shape in enumerate([(90, 120, 3), (160, 100, 3)]):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), rng.integers(0, 255, shape, dtype=np.uint8))
    cache = ImageCache.build(tmp_path / "cache", (small_image(read_image(path), 45) for path in paths))
    assert [cache[0].shape, cache[1].shape] == [(45, 60, 3), (72, 45, 3)]
    assert np.array_equal(cache[1], small_image(read_image(paths[1]), 45))
    paths[0].unlink()
    again = ImageCache.build(tmp_path / "cache", (small_image(read_image(path), 45) for path in paths))
    assert np.array_equal(again[0], cache[0])


@pytest.mark.parametrize(
    "camera",
    [
        Camera(320, 240, 240.0, 241.0, 163.0, 117.0, (0.092, -0.125, 0.0, 0.0)),
        Camera(640, 480, 465.0, 465.0, 315.0, 249.0, (-0.05, 0.02, 0.001, 0.0)),
        Camera(426, 240, 231.0, 231.0, 210.0, 121.0, ()),
    ],
)
def test_all_cameras_become_one_pinhole(camera: Camera) -> None:
    """A spot in a known direction lies where the virtual pinhole projects it, by whatever camera it was taken."""
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height)[:, None] + 0.5
    spots = np.array([(-0.45, -0.35), (0.42, -0.3), (0.05, 0.37)])
    sigma = camera.height / 80
    dots = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma**2)) for u, v in camera.project(spots)]
    image = np.repeat(255 * np.sum(dots, axis=0)[..., None], 3, axis=2).astype(np.uint8)
    seen = pinhole_image(image, camera, 96, 0.98)
    assert seen.shape[0] == 96 and seen.shape == small_image(image, 96).shape
    grey = seen[..., 0].astype(float)
    for u, v in spots * 0.98 * 96 + [seen.shape[1] / 2, 48]:
        columns, rows = (np.arange(int(c) - 5, int(c) + 6) for c in (u, v))
        window = grey[np.ix_(rows, columns)]
        at = [window.sum(0) @ (columns + 0.5) / window.sum(), window.sum(1) @ (rows + 0.5) / window.sum()]
        assert at == pytest.approx([u, v], abs=0.1)


def test_frames_of_two_lenses_are_trained_on_as_one_camera(tmp_path: Path) -> None:
    frames = pd.DataFrame(
        {"split": "train", "scene_index": 0, "width": [320, 640], "height": [240, 480], "cx": [163.0, 315.0]}
        | {"cy": [117.0, 249.0], "fx": [240.0, 470.0], "fy": [240.0, 470.0], "distortion": [[0.09, -0.12], []]}
    )
    frames = frames.assign(session_id="walk", gravity_x=0.0, gravity_y=1.0, gravity_z=0.0)
    frames = pd.concat([frames, pose_frame("map_cam", np.tile(np.eye(4), (2, 1, 1)))], axis=1)
    assert virtual_focal(frames) == pytest.approx((240 / 240 + 470 / 480) / 2)
    cache = ImageCache.build(tmp_path, [np.zeros((72, 96, 3), np.uint8)] * 2)
    shared = as_training_frames(frames, cache, 0.98).K_N33
    expected = np.array([[0.98 * 72, 0, 48], [0, 0.98 * 72, 36], [0, 0, 1]])
    assert np.allclose(shared, [expected, expected], rtol=0, atol=1e-12)
    captured = as_training_frames(frames, cache, None).K_N33
    assert captured[0] == pytest.approx(np.array([[72, 0, 48.9], [0, 72, 35.1], [0, 0, 1]]))


def test_hue_moves_around_the_colour_circle() -> None:
    image = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    third = torch.full((2, 1, 1, 1), 1 / 3)
    assert torch.allclose(shift_hue(image, third), image[:, [2, 0, 1]], atol=1e-5)
    assert torch.allclose(shift_hue(image, 3 * third), image, atol=1e-5)


def test_jitter_stays_in_range_and_repeats() -> None:
    image = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    first, second = (jittered(image, (0.5, 0.5, 0.5, 0.2), np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.allclose(first, image, atol=0.05)
    assert float(first.min()) >= 0 and float(first.max()) <= 1
    assert torch.equal(jittered(image, (0, 0, 0, 0), np.random.default_rng(1)), image)
