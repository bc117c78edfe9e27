"""Look-alike places of a walk without odometry, a place that it comes back to, and parts that neighbours don't link."""

from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from numpy.typing import NDArray

from groundwalk.sfm.database import create_database, image_id
from groundwalk.sfm.mapping.held_out import VerifiedPairs
from groundwalk.sfm.pairs.verification import contradicted_pairs
from groundwalk.sfm.plugins import MappingInput
from tests.known import cells

PERIOD, FOCAL, SIZE = 22, 500.0, (640, 480)
# There along a wall and half of the way back, looking at it, a metre a frame.
X = np.concatenate([np.arange(34.0), np.arange(32.5, 20, -1)])
FRAMES = len(X)


def verified_pairs(folder: Path, seed: int = 0, mixed: float = 0.0) -> tuple[VerifiedPairs, NDArray[np.bool_]]:
    """Pairs of images of a wall that repeats itself, and which of them take two places for one; a fraction of them has
    matches that are `mixed` up."""
    rng = np.random.default_rng(seed)
    count = 300
    one = np.column_stack([rng.uniform(0, PERIOD, count), rng.uniform(-2, 2, count), rng.uniform(4, 7, count)])
    points = np.concatenate([one + np.array([PERIOD * k, 0, 0]) for k in range(-1, 3)])
    names = [f"{n:02d}.jpg" for n in range(FRAMES)]
    frames = pd.DataFrame({"frame_id": names, "image": names, "session_id": "walk", "fx": FOCAL, "fy": FOCAL})
    frames = frames.assign(cx=320.0, cy=240.0, width=SIZE[0], height=SIZE[1], distortion=cells([[]] * FRAMES))
    database, seen, repeats_of = folder / "matched.db", [], {}
    create_database(database, frames, names)
    with pycolmap.Database.open(database) as opened:
        for row, x in enumerate(X):
            ray = points - np.array([x, 0.1 * np.sin(x), 0.2 * np.cos(x)])
            px = FOCAL * ray[:, :2] / ray[:, 2:] + np.array([320, 240]) + rng.normal(0, 0.2, (len(ray), 2))
            seen.append(np.flatnonzero(((px > 0) & (px < SIZE)).all(axis=1)))
            opened.write_keypoints(image_id(row), px[seen[-1]].astype(np.float32))
        for a, b in np.stack(np.triu_indices(FRAMES, 1), axis=1).tolist():
            for repeats in (False, True):
                _, i, j = np.intersect1d(seen[a] + repeats * count, seen[b], return_indices=True)
                if len(i) >= 30 and (a, b) not in repeats_of:
                    repeats_of[a, b] = repeats
                    geometry = pycolmap.TwoViewGeometry()
                    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                    j = rng.permutation(j) if (a + b) % 2 and rng.random() < mixed else j
                    geometry.inlier_matches = np.column_stack([i, j]).astype(np.uint32)
                    opened.write_two_view_geometry(image_id(a), image_id(b), geometry)
    pairs = np.array(list(repeats_of))
    return VerifiedPairs(frames=frames, pairs=pairs, matched=database, features=database), np.array(
        list(repeats_of.values())
    )


@pytest.mark.parametrize("is_walk", [True, False])
def test_look_alike_places_are_contradicted_and_a_closed_loop_is_not(tmp_path: Path, is_walk: bool) -> None:
    verified, look_alike = verified_pairs(tmp_path)
    order = np.arange(FRAMES) if is_walk else 100 * np.random.default_rng(0).permutation(FRAMES)
    is_wrong = contradicted_pairs(lambda *_: None, verified, order, MappingInput(tmp_path / "near.db", tmp_path, 0))
    far = np.abs(np.diff(verified.pairs, axis=1)[:, 0]) > 10
    assert look_alike.sum() > 30 and (far & ~look_alike).sum() > 30
    # Images in no order have no neighbours, and nothing is said of them.
    assert (is_wrong == (look_alike & is_walk)).all()


@pytest.mark.parametrize("mixed", [0.0, 0.3, 1.0])
def test_parts_that_neighbours_do_not_link_are_linked_where_most_pairs_agree(tmp_path: Path, mixed: float) -> None:
    verified, look_alike = verified_pairs(tmp_path, mixed=mixed)
    verified = VerifiedPairs(**{**vars(verified), "pairs": verified.pairs[~look_alike]})
    # Every other image first, then those between, as from a second walk.
    order = np.where(np.arange(FRAMES) % 2, 100, 0) + np.arange(FRAMES) // 2
    is_wrong = contradicted_pairs(lambda *_: None, verified, order, MappingInput(tmp_path / "near.db", tmp_path, 0))
    is_between = verified.pairs.sum(axis=1) % 2 == 1
    assert is_between.sum() > 100 and is_wrong[~is_between].sum() <= 1
    assert is_wrong[is_between].mean() == pytest.approx(mixed, abs=0.08)
