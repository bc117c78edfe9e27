"""ALIKED and LightGlue: what is asked of COLMAP, what is said where they can't be run, and how descriptors are read."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from textured_room import Room

from groundwalk.artefacts import UserError, execute
from groundwalk.sfm.database import create_database, image_id, read_descriptors
from groundwalk.sfm.pairs.features import extract_features, features_name
from groundwalk.sfm.pairs.matching import match_pairs, matching_options
from groundwalk.sfm.pairs.networks import require_model_files
from groundwalk.sfm.pairs.retrieval import vlad
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.stage import STAGE

_MODELS = {"aliked_model": "a.onnx", "aliked_lightglue_model": "b.onnx", "sift_lightglue_model": "c.onnx"}
ALIKED = SfmSettings(features="aliked", max_features=700, max_image_size=900, **_MODELS)
SIFT_LIGHTGLUE = SfmSettings(sift_matcher="lightglue", **_MODELS)


@pytest.mark.parametrize(
    ("settings", "missing"),
    [(ALIKED, ["aliked_model", "aliked_lightglue_model"]), (SIFT_LIGHTGLUE, ["sift_lightglue_model"])],
)
def test_a_missing_model_file_is_named(
    settings: SfmSettings, missing: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in missing:
        with pytest.raises(UserError) as caught:
            require_model_files(settings)
        assert f"name it in [sfm] {name} in data/scenes/" in str(caught.value)
        assert str(tmp_path / _MODELS[name]) in str(caught.value)
        (value,) = re.findall(r'set \[sfm\] (\w+ = "\w+") in data/scenes/', str(caught.value))
        require_model_files(settings.model_copy(update=tomllib.loads(value)))
        (tmp_path / _MODELS[name]).write_bytes(b"")
    require_model_files(settings)


def test_sift_needs_no_model_file() -> None:
    require_model_files(SfmSettings())


def test_the_stage_says_so_before_any_work(room: Room, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"model file that aliked_model names is missing"):
        execute(STAGE, "room", "tiny", room.data, ["features=aliked", f"aliked_model={tmp_path / 'a.onnx'}"])
    # Whatever this pycolmap was built with, it can't run these files.
    files = []
    for name in ("aliked_model", "aliked_lightglue_model"):
        (tmp_path / name).write_bytes(b"no network")
        files.append(f"{name}={tmp_path / name}")
    with pytest.raises(UserError, match="this pycolmap can't run") as caught:
        execute(STAGE, "room", "tiny", room.data, ["features=aliked", *files])
    assert "ONNX" in str(caught.value)
    assert not list(room.data.run("tiny", "room", ".sfm.partial").glob("**/*.db"))


@pytest.mark.skipif(hasattr(pycolmap.FeatureExtractionOptions(), "aliked"), reason="this pycolmap has ONNX")
@pytest.mark.parametrize("settings", [ALIKED, SIFT_LIGHTGLUE])
def test_without_onnx_the_options_refuse_networks(settings: SfmSettings) -> None:
    with pytest.raises(UserError, match="this pycolmap can't run networks"):
        matching_options(settings)


class _Asked:
    """Stands in for a pycolmap with ONNX: its options take networks, and its functions note what they were asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: list[SimpleNamespace] = []
        monkeypatch.setattr(pycolmap, "FeatureExtractionOptions", self._extraction)
        monkeypatch.setattr(pycolmap, "FeatureMatchingOptions", self._matching)
        monkeypatch.setattr(pycolmap, "extract_features", self._note("extraction_options"))
        monkeypatch.setattr(pycolmap, "match_image_pairs", self._note_matching)

    @staticmethod
    def _extraction() -> SimpleNamespace:
        return SimpleNamespace(
            type=pycolmap.FeatureExtractorType.SIFT, sift=SimpleNamespace(), aliked=SimpleNamespace()
        )

    @staticmethod
    def _matching() -> SimpleNamespace:
        return SimpleNamespace(
            type=pycolmap.FeatureMatcherType.SIFT_BRUTEFORCE,
            sift=SimpleNamespace(lightglue=SimpleNamespace()),
            aliked=SimpleNamespace(lightglue=SimpleNamespace()),
        )

    def _note(self, name: str) -> Callable[..., None]:
        return lambda *_, **named: self.calls.append(named[name])

    def _note_matching(self, _database: Path, matching: SimpleNamespace, *_: object) -> None:
        self.calls.append(matching)


def test_aliked_and_lightglue_are_asked_for_with_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    asked = _Asked(monkeypatch)

    def report(done: int, note: str = "") -> None:
        pass

    extract_features(report, database, tmp_path, ["a.jpg"], ALIKED)
    match_pairs(report, database, ["a.jpg", "b.jpg"], np.array([[0, 1]]), ALIKED, 0)
    match_pairs(report, database, ["a.jpg", "b.jpg"], np.array([[0, 1]]), SIFT_LIGHTGLUE, 0)
    extraction, aliked, sift = asked.calls
    assert extraction.type == pycolmap.FeatureExtractorType.ALIKED_N16ROT
    assert (extraction.aliked.n16rot_model_path, extraction.aliked.max_num_features) == ("a.onnx", 700)
    assert (extraction.max_image_size, extraction.use_gpu) == (900, False)
    assert aliked.type == pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
    assert aliked.aliked.lightglue.model_path == "b.onnx"
    assert sift.type == pycolmap.FeatureMatcherType.SIFT_LIGHTGLUE
    assert sift.sift.lightglue.model_path == "c.onnx"


def test_sift_is_matched_by_brute_force() -> None:
    assert matching_options(SfmSettings()).type == pycolmap.FeatureMatcherType.SIFT_BRUTEFORCE


def test_other_features_have_another_name() -> None:
    every = [
        SfmSettings(),
        SfmSettings(min_contrast=0.01),
        SfmSettings(max_image_size=700),
        SfmSettings(max_features=7),
        SfmSettings(features="aliked"),
        SfmSettings(features="aliked", max_features=7),
    ]
    assert len({features_name(settings) for settings in every}) == len(every)


def test_a_networks_descriptors_are_read_as_the_floats_that_they_are(room: Room, tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    create_database(path, room.frames.iloc[:3], ["a.jpg", "b.jpg", "c.jpg"])
    rng = np.random.default_rng(0)
    floats = rng.normal(size=(40, 128)).astype(np.float32)
    of_sift = rng.integers(0, 256, (30, 128), np.uint8)
    network = pycolmap.FeatureDescriptorsFloat(type=pycolmap.FeatureExtractorType.ALIKED_N16ROT, data=floats)
    with pycolmap.Database.open(path) as database:
        database.write_descriptors(image_id(0), pycolmap.FeatureDescriptors.from_float(network))
        database.write_descriptors(
            image_id(1), pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=of_sift)
        )
    first, second, third = read_descriptors(path, 3)
    assert np.array_equal(first, floats)
    assert first.dtype == np.float32
    assert np.array_equal(second, of_sift)
    assert second.dtype == np.uint8
    assert len(third) == 0
    # Retrieval takes them, frames without features among them.
    assert np.linalg.norm(vlad([first, first[:0], first[:20]], 4, 0), axis=1) == pytest.approx([1, 0, 1], abs=1e-5)
