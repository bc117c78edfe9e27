"""Which pairs a scene gets: recordings without VIO, with times and without; and which frames retrieval finds."""

from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest

from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import create_database, image_id
from groundwalk.sfm.pairs import selection
from groundwalk.sfm.pairs.candidates import first_origins
from groundwalk.sfm.pairs.odometry import Odometry, odometry
from groundwalk.sfm.pairs.selection import Proposals, pairs_by_images, pairs_within_sessions, retrieval_pairs, vlad
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import Clock, PairOrigin

_SETTINGS = SfmSettings(retrieval_pairs=4, sequence_pairs=2)
_LANDMARKS, _SEEN, _STREET_FRAMES = 400, 60, 30


class _Scene:
    """Recordings that go once round the same object: frame k of n sees the landmarks there. `has_vio` and `clock` are
    by recording; `order` says in which order of names and times the photos of each are."""

    def __init__(self, folder: Path, clocks: dict[str, Clock], has_vio: tuple[str, ...], order: np.ndarray) -> None:
        count = len(order)
        self.recording = np.repeat(np.array(list(clocks), object), count)
        self.place = np.tile(order, len(clocks))
        self.frames = pd.DataFrame(
            {
                "frame_id": [f"{r}/{k:06d}" for r in clocks for k in range(count)],
                "t_ns": np.tile(np.arange(count), len(clocks)) * 1_000_000_000,
                "clock": [clocks[str(r)] for r in self.recording],
                "support": False,
                "fx": 100.0, "fy": 100.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100,
            }
        )  # fmt: skip
        self.frames["distortion"] = [[]] * len(self.frames)
        self.database = folder / "features.db"
        create_database(self.database, self.frames, [f"{i}.jpg" for i in self.frames["frame_id"]])
        rng = np.random.default_rng(0)
        landmarks = rng.gamma(0.5, 30, (_LANDMARKS, 128))
        with pycolmap.Database.open(self.database) as opened:
            for row, place in enumerate(self.place):
                seen = (_LANDMARKS * place // count + np.arange(_SEEN)) % _LANDMARKS
                noisy = np.clip(landmarks[seen] + rng.normal(0, 4, (_SEEN, 128)), 0, 255).astype(np.uint8)
                described = pycolmap.FeatureDescriptors(data=noisy, type=pycolmap.FeatureExtractorType.SIFT)
                opened.write_descriptors(image_id(row), described)
        vio_T_cam: Array = np.tile(np.eye(4), (len(self.frames), 1, 1))
        vio_T_cam[:, 0, 3] = 100.0 * self.place
        vio_T_cam[~np.isin(self.recording, has_vio)] = np.nan
        gravity = np.full((len(self.frames), 3), np.nan)
        t_ns = self.frames["t_ns"].to_numpy(np.int64)
        self.vio: Odometry = odometry(self.recording, self.recording, t_ns, vio_T_cam, gravity, [])

    def by_order(self) -> Proposals:
        return pairs_within_sessions(_SETTINGS, self.frames, self.vio)

    def by_images(self) -> Proposals:
        return pairs_by_images(_SETTINGS, self.vio, self.by_order(), self.database, 0)

    def all(self) -> tuple[np.ndarray, np.ndarray]:
        return first_origins([*self.by_order(), *self.by_images()], len(self.frames))

    def apart(self, pairs: np.ndarray) -> np.ndarray:
        """How many places lie between the frames of each pair, the shorter way round."""
        count = self.place.max() + 1
        between = np.abs(self.place[pairs[:, 0]] - self.place[pairs[:, 1]])
        return np.minimum(between, count - between)


def _shuffled(count: int) -> np.ndarray:
    return np.random.default_rng(1).permutation(count)


def test_few_frames_of_several_recordings_without_vio_are_all_paired_too(tmp_path: Path) -> None:
    clocks = {"video": Clock.VIDEO, "photos": Clock.NAME_ORDER, "walk": Clock.BOOT}
    scene = _Scene(tmp_path, clocks, ("walk",), np.arange(20))
    pairs, _ = scene.all()
    free = (scene.recording[pairs] != "walk").all(axis=1)
    assert free.sum() == 40 * 39 / 2
    of_walk = (scene.recording[pairs] == "walk").all(axis=1)
    # VIO is 100 m apart from frame to frame: there the next frame alone is tried.
    assert of_walk.sum() == 19
    assert (~free & ~of_walk).any()


@pytest.mark.parametrize("clock", [Clock.NAME_ORDER, Clock.VIDEO])
def test_of_many_frames_without_vio_the_similar_ones_of_the_recording_are_tried(
    clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selection, "_MAX_EXHAUSTIVE", 49)
    order = np.arange(50) if clock.has_times else _shuffled(50)
    scene = _Scene(tmp_path, {"photos": clock}, (), order)
    pairs, origin = scene.all()
    similar = pairs[origin == PairOrigin.RETRIEVAL]
    assert 50 <= len(similar) <= _SETTINGS.retrieval_pairs * 50
    assert np.quantile(scene.apart(similar), 0.95) <= 5
    # Where names are in no order none is made of it; a video's neighbours are known, and the images add others.
    in_sequence = {tuple(pair) for pair in pairs[origin == PairOrigin.SEQUENCE]}
    assert len(in_sequence) == (sum(50 - step for step in (1, 2, 8, 16, 32)) if clock.has_times else 0)
    assert not in_sequence & {tuple(pair) for pair in similar}
    # First and last frame are neighbours round the object, which only the images tell.
    ends = np.flatnonzero(np.isin(scene.place, (0, 49)))
    assert (similar == ends).all(axis=1).any()


def _descriptors(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Two walks along the same street: frame i of each sees the landmarks around its place, noisily."""
    rng, count, in_view = np.random.default_rng(seed), 600, 120
    landmarks = rng.gamma(0.5, 30, (count, 128))
    first = np.linspace(0, count - in_view, _STREET_FRAMES).astype(int)
    images = [
        np.clip(landmarks[start : start + in_view] + rng.normal(0, 8, (in_view, 128)), 0, 255).astype(np.uint8)
        for start in np.concatenate([first, first])
    ]
    return images, np.repeat([0, 1], _STREET_FRAMES)


def _vlad(images: list[np.ndarray], seed: int) -> np.ndarray:
    return vlad(images.__getitem__, [*map(len, images)], seed)


def test_the_most_similar_frames_of_the_other_walk_are_those_of_the_same_place() -> None:
    images, session = _descriptors(0)
    pairs = retrieval_pairs(_vlad(images, 0), session, 3)
    assert (session[pairs[:, 0]] != session[pairs[:, 1]]).all()
    assert np.array_equal(pairs, np.unique(pairs, axis=0))
    assert len(pairs) <= 3 * len(images)
    place = pairs % _STREET_FRAMES
    assert np.mean(np.abs(place[:, 0] - place[:, 1]) <= 2) > 0.95
    assert set(pairs.ravel()) == set(range(len(images)))


def test_same_seed_same_descriptors_and_an_image_without_features_is_no_obstacle() -> None:
    images, session = _descriptors(1)
    images[3] = np.empty((0, 0), np.uint8)
    once, again = _vlad(images, 5), _vlad(images, 5)
    assert np.array_equal(once, again)
    assert np.isfinite(once).all()
    assert np.allclose(np.delete(np.linalg.norm(once, axis=1), 3), 1, atol=1e-5)
    assert len(retrieval_pairs(once, session, 3)) > 0 == len(retrieval_pairs(once, np.zeros(len(images)), 5))
