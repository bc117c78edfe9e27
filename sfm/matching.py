"""Matching of proposed pairs, and their geometric verification."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from artefacts.child import Report
from sfm.database import have_results, image_id
from sfm.features import extraction_options
from sfm.networks import cannot_run, options_of_network
from sfm.odometry import Comparison
from sfm.pairs import Pairs
from sfm.settings import SfmSettings

_CHUNK = 128
_TRIED_PX = 64
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment of the process that matches: on products as small as a pair's, more threads cost more than they gain."""
_LENGTH = 512.0
_FARTHEST, _FARTHEST_SHARE = 0.7, 0.8  # COLMAP's
# Nearly all matches are right: RANSAC's confidence asks for ten trials or so, and COLMAP's least number is a hundred.
_FEWEST_TRIALS = 30


@dataclass(frozen=True)
class MatchedPairs:
    """P pairs of frames, each with who proposed it, its matches and its verified inliers, all arrays (P, ...), and how
    the poses of those with inliers enough compare with VIO."""

    pairs: Pairs
    origin: NDArray[np.str_]
    matches: NDArray[np.int64]
    inliers: NDArray[np.int64]
    min_inliers: int
    compared: Comparison

    @property
    def enough(self) -> NDArray[np.bool_]:
        """(P,) the pair has inliers enough."""
        return self.inliers >= self.min_inliers

    @property
    def verified(self) -> NDArray[np.bool_]:
        """(P,) the pair has inliers enough, and nothing that VIO knows speaks against it."""
        return self.enough & self.compared.agrees

    @property
    def verdict(self) -> NDArray[np.object_]:
        """(P,) verified, rejected or disagrees."""
        refused = np.where(self.enough, "disagrees", "rejected")
        return np.where(self.verified, "verified", refused).astype(object)


def matching_options(settings: SfmSettings) -> pycolmap.FeatureMatchingOptions:
    """COLMAP's options; UserError where they ask for a network that this COLMAP has been built without.

    ALIKED's features are always matched by LightGlue (Lindenberger et al., ICCV 2023), SIFT's where the settings ask.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    if settings.features == "aliked":
        options.type = pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
        options_of_network(options, "aliked").lightglue.model_path = settings.aliked_lightglue_model
    elif settings.sift_matcher == "lightglue":
        options.type = pycolmap.FeatureMatcherType.SIFT_LIGHTGLUE
        options_of_network(options.sift, "lightglue").model_path = settings.sift_lightglue_model
    return options


def try_networks(report: Report, settings: SfmSettings) -> None:
    """Load the networks that the settings ask for, and run ALIKED on a tiny image; UserError where that fails.

    Whether COLMAP can run them shows in the attempt alone: its options pass their own check without ONNX, too.
    """
    try:
        if settings.features == "aliked":
            extractor = pycolmap.FeatureExtractor.create(extraction_options(settings), pycolmap.Device.cpu)
            extractor.extract_from_uint8_array(
                np.random.default_rng(0).integers(0, 256, (_TRIED_PX, _TRIED_PX, 3), np.uint8)
            )
        pycolmap.FeatureMatcher.create(matching_options(settings), pycolmap.Device.cpu)
    except (RuntimeError, ValueError) as error:
        raise cannot_run(settings, error) from None


def match_pairs(
    report: Report, database: Path, names: Sequence[str], pairs: Pairs, settings: SfmSettings, seed: int
) -> None:
    """Match pairs of rows (P, 2) and verify each by its essential matrix; pairs that are done are left as they are.

    Each pair's result depends on the pair and the seed alone, so that a killed run goes on as if it hadn't been.
    """
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = settings.min_inliers
    verification.ransac.random_seed = seed
    verification.ransac.min_num_trials = _FEWEST_TRIALS
    pair_list = database.with_name("pairs.txt")
    by_network = settings.features != "sift" or settings.sift_matcher == "lightglue"
    pairing = pycolmap.ImportedPairingOptions(match_list_path=pair_list, block_size=_CHUNK)
    # Verification has no progress of its own, so it gets some pairs at a time.
    done = have_results(database, pairs)
    todo = pairs[~done]
    for start in range(0, len(todo), _CHUNK):
        chunk = todo[start : start + _CHUNK]
        pair_list.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in chunk), encoding="utf-8")
        if by_network:
            pycolmap.match_image_pairs(database, matching_options(settings), pairing, verification, pycolmap.Device.cpu)
        else:
            _write_matches(database, chunk)
            pycolmap.verify_matches(database, pair_list, verification)
        report(int(done.sum()) + start + len(chunk))


def _write_matches(database: Path, pairs: Pairs) -> None:
    """Of pairs that have none yet: a killed run may have left some that weren't verified."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        todo = [(a, b) for a, b in pairs.tolist() if not opened.exists_matches(image_id(a), image_id(b))]
        descriptors = {row: opened.read_descriptors(image_id(row)).data.astype(np.float32) for row in set(chain(*todo))}
        for a, b in todo:
            matches = mutual_matches(descriptors[a], descriptors[b])
            opened.write_matches(image_id(a), image_id(b), matches)
            if not len(matches):
                # Verification would leave the pair out, and it would count as one to be done.
                opened.write_two_view_geometry(image_id(a), image_id(b), pycolmap.TwoViewGeometry())


def mutual_matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Rows (M, 2) of SIFT descriptors (A, 128) and (B, 128), of length 512, that are each other's nearest.

    The angle between them is at most 0.7 rad, and below 0.8 of the angle to either one's second nearest (Lowe,
    "Distinctive image features from scale-invariant keypoints", IJCV 2004). Every descriptor is looked at; products of
    such whole numbers are exact in single precision, so the matches are the same in any order and on any number of
    threads.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.uint32)
    product = a @ b.T
    nearest = product.argmax(axis=1)
    mutual = product.max(axis=1) == product.max(axis=0)[nearest]
    # Of two that are equally near one is taken, and thrown away below: its second nearest is just as near.
    j, first = np.unique(nearest[mutual], return_index=True)
    i = np.flatnonzero(mutual)[first]
    best = product[i, j]
    product[i, j] = -1.0
    second = np.maximum(product.max(axis=1)[i], product.max(axis=0)[j])
    angle, second_angle = (np.arccos(np.minimum(p / _LENGTH**2, 1.0)) for p in (best, second))
    kept = (angle <= _FARTHEST) & (angle < _FARTHEST_SHARE * second_angle)
    order = np.argsort(i[kept])
    return np.column_stack([i[kept], j[kept]])[order].astype(np.uint32)
