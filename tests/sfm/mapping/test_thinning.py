"""Many frames are mapped by some of their matches, and have the points of all."""

import itertools
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.sfm.database import image_id, pose_of
from groundwalk.sfm.mapping import build, thinning
from groundwalk.sfm.mapping.held_out import VerifiedPairs
from groundwalk.sfm.mapping.thinning import chosen_matches, write_thinned
from groundwalk.sfm.model import read_built, selected_models
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from tests.sfm.mapping.test_mappers import synthetic
from tests.sfm.synthetic_model import frames_of, log_of


def test_pairs_choose_the_same_tracks_however_many_have_wrong_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "_MATCHES_PER_PAIR", 10)
    rng, frames, tracks = np.random.default_rng(0), 12, 50
    pairs = list(itertools.combinations(range(frames), 2))
    ends = []
    for a, b in pairs:
        seen = np.flatnonzero(rng.random(tracks) < (0.1 if (a, b) == (0, 1) else 0.7))
        other = np.where(rng.random(len(seen)) < 0.02, rng.integers(tracks, size=len(seen)), seen)
        ends.append(np.stack([a * tracks + seen, b * tracks + other], axis=1))
    pair_M = np.repeat(np.arange(len(pairs)), [len(one) for one in ends])
    chosen = chosen_matches(pair_M, np.concatenate(ends), frames * tracks, 0)
    assert np.bincount(pair_M[chosen]).tolist() == [min(10, len(one)) for one in ends] and len(ends[0]) < 10
    # By chance alone pairs would choose all tracks alike.
    of_track = np.bincount(np.concatenate(ends)[chosen & (pair_M > 0), 0] % tracks, minlength=tracks)
    assert np.sort(of_track)[-15:].sum() > 0.75 * of_track.sum()


def test_what_is_left_are_matches_of_the_same_keypoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "_MATCHES_PER_PAIR", 20)
    given, _ = synthetic(tmp_path, 5)
    target = tmp_path / "thinned.db"
    write_thinned(given.database, target, 0)
    for a, b in itertools.combinations(map(image_id, range(5)), 2):
        all_of_pair, some = (_matched_px(path, a, b) for path in (given.database, target))
        assert some < all_of_pair and len(some) == 20
    with pycolmap.Database.open(target) as database:
        used = [np.unique(database.read_two_view_geometry(1, b).inlier_matches[:, 0]) for b in (2, 3, 4, 5)]
        assert np.unique(np.concatenate(used)).tolist() == list(range(database.num_keypoints_for_image(1)))


def test_many_frames_come_out_as_if_they_were_mapped_by_all_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pinhole = {"camera_model_id": pycolmap.CameraModelId.SIMPLE_PINHOLE, "camera_params": [1280, 512, 384]}
    given, true = synthetic(tmp_path, 8, **pinhole)
    settings = SfmSettings(lens="stated")
    frames, log = frames_of(true), log_of(true, settings)
    pairs = np.array(list(itertools.combinations(range(8), 2)))
    verified = VerifiedPairs(frames=frames, pairs=pairs, matched=given.database, features=given.database)
    models = {}
    for is_large in (False, True):
        monkeypatch.setattr(build, "is_large", lambda frames, is_large=is_large: is_large)
        source, output = MappingInput(tmp_path / f"{is_large}.db", tmp_path, 0), tmp_path / str(is_large)
        build.build_models(_no_report, verified, source, log, settings, output)
        assert (output / "thinned.db").is_file() == is_large
        (entry,) = selected_models(read_built(output))
        assert entry.images == 8
        models[is_large] = pycolmap.Reconstruction(output / entry.folder)
    assert models[True].compute_num_observations() > 0.99 * models[False].compute_num_observations()
    true_T, found_T = (np.stack([pose_of(m.image(image_id(row))) for row in range(8)]) for m in (true, models[True]))
    assert np.abs(fit_sim3(true_T[:, :3, 3], found_T[:, :3, 3]).poses(found_T) - true_T).max() < 1e-3


def _no_report(done: int, note: str = "") -> None:
    pass


def _matched_px(path: Path, a: int, b: int) -> set[tuple[float, ...]]:
    with pycolmap.Database.open(path) as database:
        matches = np.asarray(database.read_two_view_geometry(a, b).inlier_matches, int)
        both = [database.read_keypoints(i)[matches[:, side], :2] for side, i in enumerate((a, b))]
    return set(map(tuple, np.concatenate(both, axis=1).tolist()))
