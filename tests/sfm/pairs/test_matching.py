"""Matching and verifying pairs side by side, against COLMAP's own verification of the same matches."""

import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.poses import skew
from groundwalk.sfm.database import create_database, has_results, image_id, image_name, read_pair_results
from groundwalk.sfm.pairs.features import extract_features
from groundwalk.sfm.pairs.matching import MatchedPairs, guide_pairs, match_pairs, verification_options
from groundwalk.sfm.pairs.odometry import nothing_compared
from groundwalk.sfm.quality.messages import excluded_pairs
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import PairInconsistency
from tests.sfm.textured_room import Room

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

    match_pairs(quiet, ours, pairs, SETTINGS, SEED)

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
    with_features(room, together)
    shutil.copyfile(together, one_by_one)
    pairs = np.array([(0, 1), (0, 7), (1, 2), (3, 12)])

    match_pairs(quiet, together, pairs, SETTINGS, SEED)
    for pair in pairs[::-1]:
        match_pairs(quiet, one_by_one, pair[None], SETTINGS, SEED)

    with pycolmap.Database.open(together) as one, pycolmap.Database.open(one_by_one) as other:
        for a, b in pairs.tolist():
            ids = image_id(a), image_id(b)
            np.testing.assert_array_equal(one.read_matches(*ids), other.read_matches(*ids))
            found, expected = one.read_two_view_geometry(*ids), other.read_two_view_geometry(*ids)
            np.testing.assert_array_equal(found.inlier_matches, expected.inlier_matches)


def test_guided_matches_lie_along_epipolar_lines(room: Room, tmp_path: Path) -> None:
    """Essential matrices are the true ones here; of the room's pairs many are planar, and these stay as they are."""
    database = tmp_path / "database.db"
    with_features(room, database)
    pairs = np.array([(0, 1), (0, 3), (1, 4), (2, 9)])
    match_pairs(quiet, database, pairs, SETTINGS, SEED)
    b_T_a = np.linalg.inv(room.true_T_cam[pairs[:, 1]]) @ room.true_T_cam[pairs[:, 0]]
    with pycolmap.Database.open(database) as opened:
        for (a, b), motion in zip(pairs[:3].tolist(), b_T_a, strict=False):
            geometry = opened.read_two_view_geometry(image_id(a), image_id(b))
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.E = skew(motion[:3, 3] / np.linalg.norm(motion[:3, 3])) @ motion[:3, :3]
            opened.update_two_view_geometry(image_id(a), image_id(b), geometry)
        assert opened.read_two_view_geometry(image_id(2), image_id(9)).config != geometry.config
    matches, before = read_pair_results(database, pairs)

    guide_pairs(quiet, database, pairs)

    _, after = read_pair_results(database, pairs)
    assert (after[:3] > 1.05 * before[:3]).all() and after[3] == before[3]
    assert np.array_equal(read_pair_results(database, pairs)[0], matches)
    guide_pairs(quiet, database, pairs)
    assert np.array_equal(read_pair_results(database, pairs)[1], after)
    with pycolmap.Database.open(database) as opened:
        for (a, b), motion in zip(pairs[:3].tolist(), b_T_a, strict=False):
            found = opened.read_two_view_geometry(image_id(a), image_id(b)).inlier_matches
            rays, focal = [], []
            for row, column in ((a, 0), (b, 1)):
                camera = opened.read_camera(image_id(row))
                px = opened.read_keypoints(image_id(row))[found[:, column], :2].astype(float)
                rays.append(np.column_stack([np.asarray(camera.cam_from_img(px)), np.ones(len(px))]))
                focal.append(np.full(2, camera.mean_focal_length()))
            a_T_b = np.repeat(np.linalg.inv(motion)[None], len(found), axis=0)
            assert sampson_px(a_T_b, *rays, *focal).max() < 0.002 * 320 + 1e-6


def test_only_pairs_of_frames_with_few_matches_are_weak() -> None:
    pairs = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (0, 4), (4, 5)])
    matches = np.array([250, 250, 250, 250, 250, 250, 80, 80])
    inliers = np.array([90, 240, 240, 240, 240, 240, 60, 10])
    matched = MatchedPairs(pairs, np.full(8, ""), matches, inliers, 15, nothing_compared(8))
    assert matched.weak.tolist() == [False] * 6 + [True, False]


def test_a_verified_pair_of_few_inliers_links_nothing() -> None:
    pairs = np.array([(0, 1), (1, 2), (2, 3), (3, 4)])
    # Of a walk round a corner between bare walls: a pair that is verified by chance, and breaks the model all the same.
    inliers = np.array([44, 22, 30, 90])
    inconsistent = np.array(["", "", "", PairInconsistency.ROTATION], object)
    compared = replace(nothing_compared(4), reason=inconsistent)
    matched = MatchedPairs(pairs, np.full(4, ""), inliers, inliers, 15, compared)
    assert matched.verified.tolist() == [True, True, True, False]
    assert matched.links.tolist() == [True, False, True, False]


def test_matched_pairs_are_read_as_they_were_written(tmp_path: Path) -> None:
    pairs, inliers = np.array([(0, 1), (1, 2)]), np.array([44, 22])
    compared = replace(
        nothing_compared(2), rotation=np.array([0.1, np.nan]), reason=np.array(["", PairInconsistency.ROTATION], object)
    )
    written = MatchedPairs(pairs, np.array(["vio", "retrieval"]), 2 * inliers, inliers, 15, compared)
    written.save(tmp_path / "matched.npz")
    read = MatchedPairs.load(tmp_path / "matched.npz")
    assert read.min_inliers == 15 and read.verified.tolist() == [True, False]
    assert read.compared.reason.tolist() == [PairInconsistency.NONE, PairInconsistency.ROTATION]
    for name in ("pairs", "origin", "matches", "inliers"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_array_equal(read.compared.rotation, compared.rotation)


def test_pairs_without_vio_are_not_said_to_be_inconsistent_with_it() -> None:
    pairs, many = np.array([(0, 1), (1, 2), (2, 3)]), np.full(3, 90)
    reason = np.array([PairInconsistency.ROTATION, PairInconsistency.GRAVITY, PairInconsistency.GRAVITY], object)
    matched = MatchedPairs(pairs, np.full(3, ""), many, many, 15, replace(nothing_compared(3), reason=reason))
    with_vio, without = excluded_pairs(matched, np.array([True, True, False, False]))
    assert "2 verified pairs excluded: relative pose inconsistent with VIO" in with_vio
    assert "1 verified pairs excluded: relative pose inconsistent with gravity by the reference poses" in without
    (line,) = excluded_pairs(matched, np.zeros(4, bool))
    assert "inconsistent with VIO" not in line
