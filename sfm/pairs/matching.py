"""Matching of proposed pairs, and their geometric verification."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.epipolar import epipolar_px
from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import Ints, has_results, image_id
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.nearest import guided_matches, mutual_matches
from groundwalk.sfm.pairs.odometry import VioComparison
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report
from groundwalk.store.choices import PairInconsistency, PairStatus
from groundwalk.store.cores import usable_cores
from groundwalk.store.files import written_aside
from groundwalk.store.parallel import one_thread

_CHUNK = 128  # a bound on the descriptors in memory, and what a killed run matches again
# COLMAP's minimum of 100 trials is for matches of which half are wrong; it adds trials where a pair needs them.
_MIN_RANSAC_TRIALS = 30
_GUIDE = 0.002  # of an image's longer side: how far from its epipolar line a guided match may be
# Verified pairs with fewer inliers are matched again where one of their frames has fewer pairs of so many matches.
_GOOD_PAIRS, _MANY_MATCHES = 3, 200
_FEW_INLIERS = 100
# As many as COLMAP's mapper needs to register an image: a pair of fewer doesn't hold a model together.
LINK_INLIERS = 30


@dataclass(frozen=True)
class MatchedPairs:
    """P pairs of frames: what proposed each, its matches and verified inliers, all arrays (P, ...), and how the
    relative poses of those with enough inliers compare with VIO."""

    pairs: Pairs
    origin: NDArray[np.str_]
    matches: NDArray[np.int64]
    inliers: NDArray[np.int64]
    min_inliers: int
    compared: VioComparison

    def save(self, path: Path) -> None:
        """Write what `load` reads; the file is there whole or not at all."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "compared"}
        arrays |= {f.name: getattr(self.compared, f.name) for f in fields(VioComparison)}
        with written_aside(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays | {"reason": self.compared.reason.astype(str)})

    @staticmethod
    def load(path: Path) -> "MatchedPairs":
        """The pairs that `save` wrote."""
        with np.load(path) as file:
            columns = {name: file[name] for name in file.files}
        columns["reason"] = np.array([PairInconsistency(reason) for reason in columns["reason"]], object)
        compared = VioComparison(**{f.name: columns.pop(f.name) for f in fields(VioComparison)})
        return MatchedPairs(compared=compared, **columns | {"min_inliers": int(columns["min_inliers"])})

    @property
    def has_enough_inliers(self) -> NDArray[np.bool_]:
        """(P,)"""
        return self.inliers >= self.min_inliers

    @property
    def verified(self) -> NDArray[np.bool_]:
        """(P,) the pair has enough inliers and is consistent with VIO."""
        return self.has_enough_inliers & self.compared.consistent

    @property
    def of_poor_frames(self) -> NDArray[np.bool_]:
        """(P,) one of its frames has few pairs with many matches."""
        good = np.bincount(self.pairs[self.matches >= _MANY_MATCHES].ravel(), minlength=self.pairs.max(initial=0) + 1)
        return np.asarray((good < _GOOD_PAIRS)[self.pairs].any(axis=1))

    @property
    def links(self) -> NDArray[np.bool_]:
        """(P,) verified, with as many inliers as a model needs there to go on."""
        return self.verified & (self.inliers >= LINK_INLIERS)

    @property
    def has_few_inliers(self) -> NDArray[np.bool_]:
        """(P,)"""
        return self.inliers < _FEW_INLIERS

    @property
    def weak(self) -> NDArray[np.bool_]:
        """(P,) of poor frames, with enough inliers, but few."""
        return np.asarray(self.has_enough_inliers & self.has_few_inliers & self.of_poor_frames)

    @property
    def status(self) -> NDArray[np.object_]:
        """(P,) values of PairStatus."""
        refused = np.where(self.has_enough_inliers, PairStatus.INCONSISTENT_WITH_VIO, PairStatus.TOO_FEW_INLIERS)
        return np.where(self.verified, PairStatus.VERIFIED, refused).astype(object)


def verification_options(settings: SfmSettings, seed: int) -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's options to verify a pair by its essential matrix."""
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = settings.min_inliers
    options.ransac.random_seed = seed
    options.ransac.min_num_trials = _MIN_RANSAC_TRIALS
    return options


@one_thread()
def match_pairs(report: Report, database: Path, pairs: Pairs, settings: SfmSettings, seed: int) -> None:
    """Match pairs of rows (P, 2) and verify each by its essential matrix; pairs that are done are left as they are.

    Each pair's result depends on the pair and the seed alone, so that a killed run resumes with the same results.
    """
    verification = verification_options(settings, seed)
    done = has_results(database, pairs)
    todo = pairs[~done]
    for start in range(0, len(todo), _CHUNK):
        chunk = todo[start : start + _CHUNK]
        _match_nearest(database, chunk, verification)
        report(int(done.sum()) + start + len(chunk))


@one_thread()
def guide_pairs(report: Report, database: Path, pairs: Pairs) -> None:
    """Match verified pairs of rows (P, 2) again, by SIFT along the epipolar lines of their essential matrices.

    Of what is in the database only these pairs' inliers change, and to the same ones however often it is done; those of
    keypoints without descriptors, the floor's, stay.
    """
    for start in range(0, len(pairs), _CHUNK):
        _guide(database, pairs[start : start + _CHUNK])
        report(min(start + _CHUNK, len(pairs)))


def _guide(database: Path, pairs: Pairs) -> None:
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        images = _images(opened, pairs)
        rays = {row: _rays(image) for row, image in images.items()}
        focal = {row: np.full(2, image.camera.mean_focal_length()) for row, image in images.items()}

        def guided(pair: tuple[int, int]) -> NDArray[np.uint32]:
            (a, b), essential = pair, geometries[pair].E
            assert essential is not None
            limit_px = _GUIDE * max(images[a].camera.width, images[a].camera.height)

            def fits(i: Ints, j: Ints) -> NDArray[np.bool_]:
                return epipolar_px(essential, rays[a][i], rays[b][j], focal[a], focal[b]) <= limit_px

            return guided_matches(images[a].descriptors, images[b].descriptors, fits)

        geometries = {(a, b): opened.read_two_view_geometry(image_id(a), image_id(b)) for a, b in pairs.tolist()}
        calibrated = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        certain = [pair for pair, geometry in geometries.items() if geometry.config == calibrated]
        with ThreadPoolExecutor(usable_cores()) as pool:
            for (a, b), inliers in zip(certain, pool.map(guided, certain), strict=True):
                geometry = geometries[a, b]
                described = [len(images[a].descriptors), len(images[b].descriptors)]
                others = geometry.inlier_matches[(geometry.inlier_matches >= described).all(axis=1)]
                geometry.inlier_matches = np.concatenate([inliers, others])
                opened.update_two_view_geometry(image_id(a), image_id(b), geometry)


class _Image(NamedTuple):
    """A camera, its keypoints (K, 2), px, and their descriptors (K, D)."""

    camera: pycolmap.Camera
    keypoints: Array
    descriptors: NDArray[np.float32]


def _images(database: pycolmap.Database, pairs: Pairs) -> dict[int, _Image]:
    return {
        row: _Image(
            database.read_camera(image_id(row)),
            database.read_keypoints(image_id(row))[:, :2].astype(float),
            database.read_descriptors(image_id(row)).data.astype(np.float32),
        )
        for row in np.unique(pairs).tolist()
    }


def _rays(image: _Image) -> Array:
    """Rays (K, 3) with z = 1 through an image's keypoints."""
    xy = np.asarray(image.camera.cam_from_img(image.keypoints)).reshape(-1, 2)
    return np.column_stack([xy, np.ones(len(xy))])


def _match_nearest(database: Path, pairs: Pairs, verification: pycolmap.TwoViewGeometryOptions) -> None:
    """Match and verify pairs in parallel, one a core, and write the results once all are done."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        images = _images(opened, pairs)

        def match(pair: list[int]) -> tuple[NDArray[np.uint32], pycolmap.TwoViewGeometry]:
            a, b = (images[row] for row in pair)
            matches = mutual_matches(a.descriptors, b.descriptors)
            return matches, pycolmap.estimate_two_view_geometry(
                a.camera, a.keypoints, b.camera, b.keypoints, matches, verification
            )

        listed = pairs.tolist()
        with ThreadPoolExecutor(usable_cores()) as pool:
            for (a, b), (matches, geometry) in zip(listed, pool.map(match, listed), strict=True):
                opened.write_matches(image_id(a), image_id(b), matches)
                opened.write_two_view_geometry(image_id(a), image_id(b), geometry)
