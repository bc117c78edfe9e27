"""Matching and verifying pairs side by side, against COLMAP's own verification of the same matches."""

import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from textured_room import Room

from groundwalk.sfm.database import create_database, has_results, image_id, image_name, read_pair_results
from groundwalk.sfm.pairs.features import extract_features
from groundwalk.sfm.pairs.matching import match_pairs, verification_options
from groundwalk.sfm.settings import SfmSettings

SETTINGS = SfmSettings(max_features=400)
SEED = 3


def quiet(done: int, note: str = "") -> None: ...


def with_features(room: Room, database: Path) -> list[str]:
    """A database with the features of all frames; the names of its images."""
    images = database.parent / "images"
    names = [image_name(i, image) for i, image in zip(room.frames["frame_id"], room.frames["image"], strict=True)]
    for name, image in zip(names, room.frames["image"], strict=True):
        link = images / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(room.data.captures("room") / image)
    create_database(database, room.frames, names)
    extract_features(quiet, database, images, names, SETTINGS)
    return names


def test_verified_matches_are_those_of_colmap(room: Room, tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours.db", tmp_path / "theirs.db"
    names = with_features(room, ours)
    pairs = np.array(list(combinations(range(len(names)), 2)))

    match_pairs(quiet, ours, names, pairs, SETTINGS, SEED)

    shutil.copyfile(ours, theirs)
    with pycolmap.Database.open(theirs) as database:
        database.clear_two_view_geometries()
    listed = tmp_path / "pairs.txt"
    listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs), encoding="utf-8")
    pycolmap.verify_matches(theirs, listed, verification_options(SETTINGS, SEED))
    matches, inliers = read_pair_results(ours, pairs)
    assert has_results(ours, pairs).all()
    assert (matches >= inliers).all() and (inliers > 50).sum() > 20
    assert inliers.tolist() == read_pair_results(theirs, pairs)[1].tolist()
    with pycolmap.Database.open(ours) as one, pycolmap.Database.open(theirs) as other:
        for a, b in pairs[inliers > 0].tolist():
            found, expected = (d.read_two_view_geometry(image_id(a), image_id(b)) for d in (one, other))
            np.testing.assert_array_equal(found.inlier_matches, expected.inlier_matches)
            assert found.config == expected.config


def test_each_pair_is_matched_alike_whatever_is_matched_beside_it(room: Room, tmp_path: Path) -> None:
    together, one_by_one = tmp_path / "together.db", tmp_path / "one_by_one.db"
    names = with_features(room, together)
    shutil.copyfile(together, one_by_one)
    pairs = np.array([(0, 1), (0, 7), (1, 2), (3, 12)])

    match_pairs(quiet, together, names, pairs, SETTINGS, SEED)
    for pair in pairs[::-1]:
        match_pairs(quiet, one_by_one, names, pair[None], SETTINGS, SEED)

    with pycolmap.Database.open(together) as one, pycolmap.Database.open(one_by_one) as other:
        for a, b in pairs.tolist():
            ids = image_id(a), image_id(b)
            np.testing.assert_array_equal(one.read_matches(*ids), other.read_matches(*ids))
            found, expected = one.read_two_view_geometry(*ids), other.read_two_view_geometry(*ids)
            np.testing.assert_array_equal(found.inlier_matches, expected.inlier_matches)
