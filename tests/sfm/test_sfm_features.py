"""Which features images get: of rich ones those of a smaller image, of poor ones also those of less contrast."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.database import Ints, create_database, keypoint_counts, read_keypoints
from groundwalk.sfm.pairs.features import extract_features
from groundwalk.sfm.settings import SfmSettings

NAMES = ["0.png", "1.png", "2.png"]
WIDTH, HEIGHT = 640, 480


def quiet(done: int, note: str = "") -> None: ...


def noise(contrast: float, seed: int) -> np.ndarray:
    """Blobs of all sizes, whose grey levels have this standard deviation."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.normal(size=(HEIGHT // n, WIDTH // n)), (WIDTH, HEIGHT)) for n in (4, 8, 16, 32)]
    grey = np.sum(layers, axis=0)
    return np.clip(128 + contrast * grey / grey.std(), 0, 255).astype(np.uint8)


def counts_of(folder: Path, contrasts: list[float], settings: SfmSettings) -> tuple[Path, Ints]:
    frame = {"width": WIDTH, "height": HEIGHT, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "distortion": []}
    for seed, (name, contrast) in enumerate(zip(NAMES, contrasts, strict=True)):
        cv2.imwrite(str(folder / name), noise(contrast, seed))
    database = folder / "features.db"
    create_database(database, pd.DataFrame([frame] * len(NAMES)), NAMES)
    extract_features(quiet, database, folder, NAMES, settings)
    return database, keypoint_counts(database, len(NAMES))


def test_an_image_with_few_features_gets_fainter_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SfmSettings(max_features=500)
    _, counts = counts_of(tmp_path, [40.0, 40.0, 2.0], settings)
    monkeypatch.setattr("groundwalk.sfm.pairs.features._FAINT_CONTRAST", 0.02 / 3)
    (tmp_path / "features.db").unlink()
    _, before = counts_of(tmp_path, [40.0, 40.0, 2.0], settings)
    assert counts[:2].tolist() == before[:2].tolist()
    assert before[2] < 0.7 * settings.max_features and counts[2] > 1.3 * before[2]


def test_rich_images_are_shrunk_and_keypoints_stay_in_full_pixels(tmp_path: Path) -> None:
    database, counts = counts_of(tmp_path, [40.0] * 3, SfmSettings(max_features=100, max_image_size=WIDTH))
    assert (counts >= 100).all()
    assert all(0.7 * WIDTH < xy[:, 0].max() < WIDTH for xy in read_keypoints(database, len(NAMES)))


def test_a_killed_extraction_goes_on_to_the_same_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, contrasts = SfmSettings(max_features=500), [40.0, 2.0, 2.0]
    database, _ = counts_of(tmp_path, contrasts, settings)
    expected = read_keypoints(database, len(NAMES))
    database.unlink()
    monkeypatch.setattr("groundwalk.sfm.pairs.features._FEW_FRACTION", 0.0)
    counts_of(tmp_path, contrasts, settings)
    monkeypatch.undo()
    extract_features(quiet, database, tmp_path, NAMES, settings)
    for found, wanted in zip(read_keypoints(database, len(NAMES)), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)
