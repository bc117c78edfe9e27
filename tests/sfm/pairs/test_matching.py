"""Matching and verifying pairs: against COLMAP's own verification, and a literal reading of the rule of matches."""

import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.poses import skew
from groundwalk.sfm.database import (
    Workspace,
    create_database,
    extract_features,
    has_results,
    image_id,
    image_names,
    read_pair_results,
)
from groundwalk.sfm.pairs.matched import MIN_INLIERS, are_verified, are_weak, checkpoint, matched_pairs, status_of
from groundwalk.sfm.pairs.matching import guide_pairs, guided_matches, match_pairs, mutual_matches
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import PairInconsistency
from tests.sfm.textured_room import Room

SETTINGS = SfmSettings(max_features=400)
SEED = 3


def quiet(done: int, note: str = "") -> None: ...


def with_features(room: Room, database: Path) -> list[str]:
    """A database with the features of all frames; the names of its images."""
    images = database.parent / "images"
    names = image_names(room.frames)
    for name, image in zip(names, room.frames["image"], strict=True):
        link = images / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(room.data.captures("room") / image)
    create_database(database, room.frames, names)
    extract_features(quiet, database, Workspace(images, names, images, {}), SETTINGS)
    return names


def test_verified_matches_are_those_of_colmap(room: Room, tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours.db", tmp_path / "theirs.db"
    names = with_features(room, ours)
    pairs = np.array(list(combinations(range(len(names)), 2)))

    match_pairs(quiet, ours, pairs, SEED)

    shutil.copyfile(ours, theirs)
    with pycolmap.Database.open(theirs) as database:
        database.clear_two_view_geometries()
    listed = tmp_path / "pairs.txt"
    listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in pairs), encoding="utf-8")
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers, options.ransac.random_seed, options.ransac.min_num_trials = MIN_INLIERS, SEED, 30
    pycolmap.verify_matches(theirs, listed, options)
    matches, inliers = read_pair_results(ours, pairs)
    assert has_results(ours, pairs).all()
    assert (matches >= inliers).all() and (inliers > 50).sum() > 20
    assert inliers.tolist() == read_pair_results(theirs, pairs)[1].tolist()
    with pycolmap.Database.open(ours) as one, pycolmap.Database.open(theirs) as other:
        for a, b in pairs[inliers > 0].tolist():
            found, expected = (d.read_two_view_geometry(image_id(a), image_id(b)) for d in (one, other))
            np.testing.assert_array_equal(found.inlier_matches, expected.inlier_matches)
            assert found.config == expected.config


def test_guided_matches_lie_along_epipolar_lines(room: Room, tmp_path: Path) -> None:
    """Essential matrices are the true ones here; of the room's pairs many are planar, and these stay as they are."""
    database = tmp_path / "database.db"
    with_features(room, database)
    pairs = np.array([(0, 1), (0, 3), (1, 4), (2, 9)])
    match_pairs(quiet, database, pairs, SEED)
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


def _table(pairs: np.ndarray, matches: list[int], inliers: list[int]) -> pd.DataFrame:
    return matched_pairs(pairs, np.full(len(pairs), "vio"), np.array(matches), np.array(inliers))


def test_only_pairs_of_frames_with_few_matches_are_weak() -> None:
    pairs = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3), (0, 4), (4, 5)])
    matched = _table(pairs, [250] * 6 + [80, 80], [90, 240, 240, 240, 240, 240, 60, 10])
    assert are_weak(matched).tolist() == [False] * 6 + [True, True]


def test_a_pair_is_verified_by_its_inliers_and_by_vio_and_read_as_it_was_written(tmp_path: Path) -> None:
    pairs = np.array([(0, 1), (1, 2), (2, 3)])
    matched = _table(pairs, [90] * 3, [44, 14, 90])
    matched["rotation"] = [np.nan, np.nan, 0.7]
    matched["reason"] = ["", "", PairInconsistency.ROTATION]
    written = checkpoint(tmp_path / "matched.parquet", lambda: matched)
    read = checkpoint(tmp_path / "matched.parquet", lambda: matched[:0])
    for table in (matched, written, read):
        assert are_verified(table).tolist() == [True, False, False]
        assert status_of(table).tolist() == ["verified", "too_few_inliers", "inconsistent_with_vio"]
    pd.testing.assert_frame_equal(read, matched, check_dtype=False)


def sift_like(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Descriptors (count, 128) as COLMAP keeps them: whole numbers, of length 512."""
    raw = rng.exponential(size=(count, 128))
    return np.round(512 * raw / np.linalg.norm(raw, axis=1, keepdims=True)).astype(np.float32)


def seen_again(rng: np.random.Generator, seen: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    moved = np.abs(seen + rng.normal(scale=noise, size=seen.shape))
    return np.round(512 * moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)


def literal(a: NDArray[np.float32], b: NDArray[np.float32]) -> list[tuple[int, int]]:
    def angles(one: NDArray[np.float32], others: NDArray[np.float32]) -> list[float]:
        return [float(np.arccos(min(1.0, float(one.astype(int) @ o.astype(int)) / 512**2))) for o in others]

    def best(ones: NDArray[np.float32], others: NDArray[np.float32]) -> dict[int, int]:
        found = {}
        for i, one in enumerate(ones):
            order = sorted(enumerate(angles(one, others)), key=lambda entry: entry[1])
            (j, first), (_, second) = order[0], order[1]
            if first <= 0.7 and first < 0.8 * second:
                found[i] = j
        return found

    forth, back = best(a, b), best(b, a)
    return [(i, j) for i, j in forth.items() if back.get(j) == i]


def test_matches_are_those_of_the_literal_rule() -> None:
    rng = np.random.default_rng(0)
    a = sift_like(rng, 40)
    b = np.concatenate([seen_again(rng, a[::2], 8.0), seen_again(rng, a[::5], 16.0), sift_like(rng, 12)])
    b = b[rng.permutation(len(b))]
    found = [tuple(row) for row in mutual_matches(a, b).tolist()]
    assert found == literal(a, b)
    assert 8 < len(found) < 40


def test_a_descriptor_that_is_there_twice_matches_nothing_nor_does_no_feature() -> None:
    a = sift_like(np.random.default_rng(2), 6)
    assert mutual_matches(a, np.concatenate([a, a[:1]]))[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert mutual_matches(a[:0], a).shape == mutual_matches(a, a[:0]).shape == (0, 2)


def test_of_a_repeated_pattern_what_fits_is_matched() -> None:
    a = sift_like(np.random.default_rng(5), 4)
    b = np.repeat(a, 2, axis=0)  # each feature is seen twice
    assert len(mutual_matches(a, b)) == 0
    found = guided_matches(a, b, lambda i, j: j == 2 * i + 1)
    assert found.tolist() == [[i, 2 * i + 1] for i in range(4)]
    assert len(guided_matches(a, b, lambda i, j: np.zeros(len(i), bool))) == 0
