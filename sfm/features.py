"""SIFT features of all frames."""

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from artefacts.child import Report
from sfm.settings import SfmSettings

_CHUNK = 8


def extract_features(report: Report, database: Path, images: Path, names: Sequence[str], settings: SfmSettings) -> None:
    """Extract SIFT features of the named images into the database; images that have theirs are skipped.

    Images larger than the settings' cap are shrunk first; keypoints are in pixels of the full image.
    """
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = settings.threads
    options.max_image_size = settings.max_image_size
    options.sift.max_num_features = settings.max_features
    options.sift.first_octave = settings.first_octave
    # Extraction has no progress of its own, so it gets a few images at a time.
    for start in range(0, len(names), _CHUNK):
        chunk = names[start : start + _CHUNK]
        pycolmap.extract_features(
            database,
            images,
            image_names=chunk,
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        report(start + len(chunk))
