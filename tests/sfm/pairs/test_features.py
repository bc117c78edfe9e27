"""Features: in pixels of the full image, and those that a killed run extracted are kept."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap

from groundwalk.sfm.database import Workspace, create_database, extract_features, keypoint_counts, read_keypoints
from groundwalk.sfm.settings import SfmSettings

NAMES = ["0.png", "1.png", "2.png"]
WIDTH, HEIGHT = 640, 480


def quiet(done: int, note: str = "") -> None: ...


def images_in(folder: Path, names: Sequence[str] = NAMES) -> Workspace:
    return Workspace(folder, names, folder, {})


def images_and_database(folder: Path) -> Path:
    """Images of blobs of all sizes, and a database without features."""
    rng = np.random.default_rng(0)
    for name in NAMES:
        layers = [cv2.resize(rng.normal(size=(HEIGHT // n, WIDTH // n)), (WIDTH, HEIGHT)) for n in (4, 8, 16, 32)]
        grey = np.sum(layers, axis=0)
        cv2.imwrite(str(folder / name), np.clip(128 + 40 * grey / grey.std(), 0, 255).astype(np.uint8))
    frame = {"width": WIDTH, "height": HEIGHT, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "distortion": []}
    create_database(folder / "features.db", pd.DataFrame([frame] * len(NAMES)), NAMES)
    return folder / "features.db"


def test_keypoints_of_shrunk_images_are_in_pixels_of_the_full_image(tmp_path: Path) -> None:
    database = images_and_database(tmp_path)
    extract_features(quiet, database, images_in(tmp_path), SfmSettings(max_features=100, max_image_size=WIDTH // 2))
    assert (keypoint_counts(database, len(NAMES)) == 100).all()
    assert all(0.7 * WIDTH < xy[:, 0].max() < WIDTH for xy in read_keypoints(database, len(NAMES)))


def test_a_killed_extraction_goes_on_to_the_same_features(tmp_path: Path) -> None:
    settings = SfmSettings(max_features=500)
    database = images_and_database(tmp_path)
    extract_features(quiet, database, images_in(tmp_path, NAMES[:1]), settings)
    assert (keypoint_counts(database, len(NAMES)) > 0).tolist() == [True, False, False]
    first = read_keypoints(database, len(NAMES))[0]
    (tmp_path / NAMES[0]).unlink()  # it isn't read again
    extract_features(quiet, database, images_in(tmp_path), settings)
    assert (keypoint_counts(database, len(NAMES)) > 0).all()
    np.testing.assert_array_equal(read_keypoints(database, len(NAMES))[0], first)


def test_blurred_boxes_get_no_features(tmp_path: Path) -> None:
    settings, found = SfmSettings(max_features=500), []
    boxes = np.array([[100.0, 50.0, 300.0, 250.0], [-20.0, 400.0, 60.0, 500.0]])
    for blurred in ({}, {"1.png": boxes}):
        (tmp_path / "features.db").unlink(missing_ok=True)
        database = images_and_database(tmp_path)
        extract_features(quiet, database, Workspace(tmp_path, NAMES, tmp_path, blurred), settings)
        found.append(read_keypoints(database, len(NAMES)))
        with pycolmap.Database.open(database) as opened:
            assert [opened.read_descriptors(n + 1).data.shape[0] for n in range(3)] == [len(px) for px in found[-1]]
    (first, px, last), (same_first, fewer, same_last) = found
    is_inside = np.zeros(len(px), bool)
    for left, top, right, bottom in boxes:
        is_inside |= (px[:, 0] > left) & (px[:, 0] < right) & (px[:, 1] > top) & (px[:, 1] < bottom)
    assert np.count_nonzero(is_inside) > 20
    np.testing.assert_array_equal(fewer, px[~is_inside])
    np.testing.assert_array_equal(same_first, first)
    np.testing.assert_array_equal(same_last, last)
