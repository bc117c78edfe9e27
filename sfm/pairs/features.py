"""Features of all frames: SIFT, or ALIKED (Zhao et al., IEEE TIM 2023) where its network can be run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.artefacts.child import Report
from groundwalk.sfm.database import Ints, drop_features, keypoint_counts, longest_side
from groundwalk.sfm.pairs.networks import options_of_network
from groundwalk.sfm.settings import SfmSettings

# COLMAP starts anew for each chunk, and cores wait for its last image; progress is reported at its end.
_CHUNK_SIZES = (8, 64)
_CHUNKS = 12
# COLMAP keeps the largest features: of a rich image that is shrunk to this fraction of `max_image_size` the same ones,
# in less than half of the time. Some images tell whether those of a scene are rich.
_COARSE = 0.625
_SAMPLE = 8
# An image with fewer features than this fraction of `max_features` gets those of less contrast, too: COLMAP's limit is
# 0.0067 of the range of grey levels. Where an image has enough, faint ones would only displace better ones.
_FEW_FRACTION = 0.7
_FAINT_CONTRAST = 0.002


def features_name(settings: SfmSettings) -> str:
    """Settings with the same name have the same features."""
    if settings.features == "aliked":
        return f"_aliked_{settings.max_features}"
    return f"{settings.first_octave}_{settings.max_features}"


def extraction_options(settings: SfmSettings) -> pycolmap.FeatureExtractionOptions:
    """COLMAP's options; UserError where they need a network that this COLMAP was built without."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = settings.threads
    options.max_image_size = settings.max_image_size
    if settings.features == "aliked":
        options.type = pycolmap.FeatureExtractorType.ALIKED_N16ROT
        aliked = options_of_network(options, "aliked")
        aliked.max_num_features = settings.max_features
        aliked.n16rot_model_path = settings.aliked_model
    else:
        options.sift.max_num_features = settings.max_features
        options.sift.first_octave = settings.first_octave
    return options


def extract_features(report: Report, database: Path, images: Path, names: Sequence[str], settings: SfmSettings) -> None:
    """Extract features of the named images, all that the database has, into it. What an earlier, killed run did is
    reused.

    Images larger than max_image_size are shrunk first; keypoints are in pixels of the full image. SIFT is tried on
    images that are shrunk more where those have enough features, and with less contrast where they have few.
    """
    options = extraction_options(settings)
    every = np.arange(len(names))

    def extract(rows: Ints) -> None:
        _extract(report, database, images, [names[row] for row in rows], options)

    def with_fewer(than: float) -> Ints:
        return np.flatnonzero(keypoint_counts(database, len(names)) < than)

    if settings.features == "aliked":
        extract(every)
        return
    options.max_image_size = round(_COARSE * settings.max_image_size)
    if longest_side(database) > options.max_image_size:
        sample = np.unique(np.linspace(0, len(names) - 1, _SAMPLE).round().astype(np.int64))
        drop_features(database, sample)
        extract(sample)
        if np.isin(sample, with_fewer(settings.max_features)).mean() < 0.5:
            extract(every)
    options.max_image_size = settings.max_image_size
    for fraction, contrast in ((1.0, options.sift.peak_threshold), (_FEW_FRACTION, _FAINT_CONTRAST)):
        few = with_fewer(fraction * settings.max_features)
        drop_features(database, few)
        options.sift.peak_threshold = contrast
        extract(few)


def _extract(
    report: Report,
    database: Path,
    images: Path,
    names: Sequence[str],
    options: pycolmap.FeatureExtractionOptions,
) -> None:
    # COLMAP reports no progress of extraction, so it gets some images at a time.
    size = int(np.clip(len(names) // _CHUNKS, *_CHUNK_SIZES))
    for start in range(0, len(names), size):
        chunk = names[start : start + size]
        pycolmap.extract_features(
            database,
            images,
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        report(start + len(chunk))
