"""Matching of proposed pairs, and their geometric verification."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from artefacts.child import Report
from sfm.database import have_results
from sfm.features import extraction_options
from sfm.nearest import write_nearest
from sfm.networks import cannot_run, model_files, options_of_network
from sfm.odometry import Comparison
from sfm.pairs import Pairs
from sfm.settings import SfmSettings

_CHUNK = 512  # COLMAP opens the database anew for each chunk that it verifies
_MATCHED_TOGETHER = 128  # a bound on the descriptors in memory
_TRIED_PX = 64
# COLMAP's 100 trials at least are for matches of which half are wrong; how many more a pair needs it finds itself.
_FEWEST_TRIALS = 30
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment of the process that matches: pairs are matched side by side, each on one thread."""


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
    """COLMAP's options to match by a network; UserError where this COLMAP has been built without.

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
    listed = database.with_name("pairs.txt")
    # COLMAP's matching and verification have no progress of their own, so they get some pairs at a time.
    done = have_results(database, pairs)
    todo = pairs[~done]
    for start in range(0, len(todo), _CHUNK):
        chunk = todo[start : start + _CHUNK]
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in chunk), encoding="utf-8")
        if model_files(settings):
            pairing = pycolmap.ImportedPairingOptions()
            pairing.block_size = _CHUNK
            pairing.match_list_path = listed
            pycolmap.match_image_pairs(database, matching_options(settings), pairing, verification, pycolmap.Device.cpu)
        else:
            for first in range(0, len(chunk), _MATCHED_TOGETHER):
                write_nearest(database, chunk[first : first + _MATCHED_TOGETHER])
            pycolmap.verify_matches(database, listed, verification)
        report(int(done.sum()) + start + len(chunk))
