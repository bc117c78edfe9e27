"""Features of all frames: SIFT, or ALIKED (Zhao et al., IEEE TIM 2023) where its network can be run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.artefacts.child import Report
from groundwalk.sfm.pairs.networks import options_of_network
from groundwalk.sfm.settings import SfmSettings

# COLMAP starts anew for each chunk, and cores wait for its last image; progress is reported at its end.
_CHUNK_SIZES = (8, 64)
_CHUNKS = 12


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
    """Extract features of the named images into the database; images that have theirs are skipped.

    Images larger than max_image_size are shrunk first; keypoints are in pixels of the full image.
    """
    options = extraction_options(settings)
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
