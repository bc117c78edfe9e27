"""Matching of proposed pairs, and their geometric verification."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.epipolar import epipolar_px
from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import Ints, has_results, image_id, keypoints_px
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.matched import MIN_INLIERS
from groundwalk.store.child import Report
from groundwalk.store.cores import usable_cores
from groundwalk.store.parallel import one_thread

_CHUNK = 128  # a bound on the descriptors in memory, and what a killed run matches again
# COLMAP's minimum of 100 trials is for matches of which half are wrong; it adds trials where a pair needs them.
_MIN_RANSAC_TRIALS = 30
_GUIDE = 0.002  # of an image's longer side: how far from its epipolar line a guided match may be
_LENGTH = 512.0  # of descriptors
_MAX_ANGLE, _MAX_RATIO = 0.7, 0.8  # COLMAP's


@one_thread()
def match_pairs(report: Report, database: Path, pairs: Pairs, seed: int) -> None:
    """Match pairs of rows (P, 2) and verify each by its essential matrix; pairs that are done are left as they are.

    Each pair's result depends on the pair and the seed alone, so that a killed run resumes with the same results.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_INLIERS
    options.ransac.random_seed = seed
    options.ransac.min_num_trials = _MIN_RANSAC_TRIALS

    def match(
        a: _Image, b: _Image, known: NDArray[np.uint32] | None
    ) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]:
        matches = mutual_matches(a.descriptors, b.descriptors) if known is None else known
        ends = (a.camera, a.keypoints, b.camera, b.keypoints)
        return matches, pycolmap.estimate_two_view_geometry(*ends, matches, options)

    is_done = has_results(database, pairs)
    todo = pairs[~is_done]
    for start in range(0, len(todo), _CHUNK):
        chunk = todo[start : start + _CHUNK].tolist()
        with (
            pycolmap.Database.open(database) as opened,
            pycolmap.DatabaseTransaction(opened),
            ThreadPoolExecutor(usable_cores()) as pool,
        ):
            images = _images(opened, chunk)
            # An earlier run's, of the same features.
            known = {
                (a, b): opened.read_matches(image_id(a), image_id(b))
                for a, b in chunk
                if opened.exists_matches(image_id(a), image_id(b))
            }
            jobs = [(images[a], images[b], known.get((a, b))) for a, b in chunk]
            for (a, b), (matches, geometry) in zip(chunk, pool.map(lambda job: match(*job), jobs), strict=True):
                if (a, b) not in known:
                    opened.write_matches(image_id(a), image_id(b), matches)
                opened.write_two_view_geometry(image_id(a), image_id(b), geometry)
        report(int(is_done.sum()) + start + len(chunk))


@one_thread()
def guide_pairs(report: Report, database: Path, pairs: Pairs) -> None:
    """Match verified pairs of rows (P, 2) again, by SIFT along the epipolar lines of their essential matrices.

    Of what is in the database only these pairs' inliers change, and to the same ones however often it is done; those of
    keypoints without descriptors, the floor's, stay.
    """
    calibrated = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    for start in range(0, len(pairs), _CHUNK):
        chunk = pairs[start : start + _CHUNK].tolist()
        with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
            images = _images(opened, chunk)
            geometries = {
                (a, b): geometry
                for a, b in chunk
                if (geometry := opened.read_two_view_geometry(image_id(a), image_id(b))).config == calibrated
            }
            with ThreadPoolExecutor(usable_cores()) as pool:
                jobs = [(images[a], images[b], geometry) for (a, b), geometry in geometries.items()]
                found = pool.map(lambda job: _guided(*job), jobs)
                for ((a, b), geometry), inliers in zip(geometries.items(), found, strict=True):
                    described = [len(images[a].descriptors), len(images[b].descriptors)]
                    others = geometry.inlier_matches[(geometry.inlier_matches >= described).all(axis=1)]
                    geometry.inlier_matches = np.concatenate([inliers, others])
                    opened.update_two_view_geometry(image_id(a), image_id(b), geometry)
        report(start + len(chunk))


@dataclass(frozen=True)
class _Image:
    """A camera, its keypoints (K, 2), px, and their descriptors (K, D)."""

    camera: pycolmap.Camera
    keypoints: Array
    descriptors: NDArray[np.float32]

    @property
    def focal(self) -> Array:
        """(2,) px"""
        return np.full(2, self.camera.mean_focal_length())

    @cached_property
    def rays(self) -> Array:
        """Rays (K, 3) with z = 1 through the keypoints."""
        xy = np.asarray(self.camera.cam_from_img(self.keypoints)).reshape(-1, 2)
        return np.column_stack([xy, np.ones(len(xy))])


def _images(database: pycolmap.Database, pairs: list[list[int]]) -> dict[int, _Image]:
    return {
        row: _Image(
            database.read_camera(database.read_image(image_id(row)).camera_id),
            keypoints_px(database, row),
            database.read_descriptors(image_id(row)).data.astype(np.float32),
        )
        for row in sorted({row for pair in pairs for row in pair})
    }


def _guided(a: _Image, b: _Image, geometry: pycolmap.TwoViewGeometry) -> NDArray[np.uint32]:
    essential, limit_px = geometry.E, _GUIDE * max(a.camera.width, a.camera.height)
    assert essential is not None

    def fits(i: Ints, j: Ints) -> NDArray[np.bool_]:
        return epipolar_px(essential, a.rays[i], b.rays[j], a.focal, b.focal) <= limit_px

    return guided_matches(a.descriptors, b.descriptors, fits)


def mutual_matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Rows (M, 2) of SIFT descriptors (A, 128) and (B, 128), of length 512, that are each other's nearest.

    The angle between them is at most 0.7 rad, and below 0.8 of the angle to either one's second nearest (Lowe,
    "Distinctive image features from scale-invariant keypoints", IJCV 2004). Products of such whole numbers are exact in
    single precision, so the matches are the same in any order and on any number of threads.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.uint32)
    return _mutual(a @ b.T)


def guided_matches(
    a: NDArray[np.float32], b: NDArray[np.float32], fits: Callable[[Ints, Ints], NDArray[np.bool_]]
) -> NDArray[np.uint32]:
    """As `mutual_matches`, among rows i (C,) of a and j (C,) of b that fit each other, (C,): of `fits`' two arguments.

    What doesn't fit is no second nearest either, so that a feature of a repeated pattern can match.
    """
    product = a @ b.T
    # A second nearest beyond this angle refuses no match.
    i, j = np.nonzero(product >= _LENGTH**2 * np.cos(_MAX_ANGLE / _MAX_RATIO))
    fit = fits(i, j)
    fitting = np.zeros_like(product)
    fitting[i[fit], j[fit]] = product[i[fit], j[fit]]
    return _mutual(fitting)


def _mutual(product: NDArray[np.float32]) -> NDArray[np.uint32]:
    nearest = product.argmax(axis=1)
    mutual = product.max(axis=1) == product.max(axis=0)[nearest]
    # Of two that are equally near one is used, and refused below: its second nearest is just as near.
    j, first = np.unique(nearest[mutual], return_index=True)
    i = np.flatnonzero(mutual)[first]
    best = product[i, j]
    product[i, j] = -1.0
    second = np.maximum(product.max(axis=1)[i], product.max(axis=0)[j])
    angle, second_angle = (np.arccos(np.minimum(p / _LENGTH**2, 1.0)) for p in (best, second))
    is_match = (angle <= _MAX_ANGLE) & (angle < _MAX_RATIO * second_angle)
    order = np.argsort(i[is_match])
    return np.column_stack([i[is_match], j[is_match]])[order].astype(np.uint32)
