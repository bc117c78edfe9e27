"""Features of all frames: SIFT, or ALIKED (Zhao et al., IEEE TIM 2023) where its network can be run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.artefacts.child import Report
from groundwalk.artefacts.images import read_grey_image
from groundwalk.artefacts.parallel import in_parallel
from groundwalk.features.sift import Features, even_sift
from groundwalk.sfm.database import image_id
from groundwalk.sfm.pairs.networks import options_of_network
from groundwalk.sfm.settings import SfmSettings

# COLMAP starts anew for each chunk, and cores wait for its last image; progress is reported at its end.
_CHUNK_SIZES = (8, 64)
_CHUNKS = 12


def features_name(settings: SfmSettings) -> str:
    """Settings with the same name have the same features."""
    contrast = "" if settings.features == "aliked" else f"_{settings.min_contrast:g}"
    return f"_{settings.features}_{settings.max_image_size}_{settings.max_features}{contrast}"


def extraction_options(settings: SfmSettings) -> pycolmap.FeatureExtractionOptions:
    """COLMAP's options of ALIKED; UserError where this COLMAP was built without networks."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = settings.threads
    options.max_image_size = settings.max_image_size
    options.type = pycolmap.FeatureExtractorType.ALIKED_N16ROT
    aliked = options_of_network(options, "aliked")
    aliked.max_num_features = settings.max_features
    aliked.n16rot_model_path = settings.aliked_model
    return options


def extract_features(report: Report, database: Path, images: Path, names: Sequence[str], settings: SfmSettings) -> None:
    """Extract features of the named images, the database's rows in order, into it; images that have theirs are skipped.

    Images larger than max_image_size are shrunk first; keypoints are in pixels of the full image.
    """
    if settings.features == "aliked":
        _extract_aliked(report, database, images, names, settings)
        return

    def features_of(row: int) -> Features:
        grey = read_grey_image(images / names[row])
        return even_sift(grey, settings.max_features, settings.max_image_size, settings.min_contrast)

    sift = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        rows = [row for row in range(len(names)) if not opened.exists_keypoints(image_id(row))]
        described = in_parallel(features_of, rows, settings.threads if settings.threads > 0 else None)
        for row, features in zip(rows, described, strict=True):
            with pycolmap.DatabaseTransaction(opened):
                opened.write_keypoints(image_id(row), features.px)
                descriptors = pycolmap.FeatureDescriptors(data=features.descriptors, type=sift)
                opened.write_descriptors(image_id(row), descriptors)
            report(row + 1)


def _extract_aliked(report: Report, database: Path, images: Path, names: Sequence[str], settings: SfmSettings) -> None:
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
