"""Features of all frames: SIFT."""

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from groundwalk.features.sift import Features, even_sift
from groundwalk.sfm.database import image_id
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel

# Half of OpenCV's: what is fainter is noise, and what is between the two joins models where walls are blank.
_MIN_CONTRAST = 0.02


def features_name(settings: SfmSettings) -> str:
    """Settings with the same name have the same features."""
    return f"_{settings.max_image_size}_{settings.max_features}"


def extract_features(report: Report, database: Path, images: Path, names: Sequence[str], settings: SfmSettings) -> None:
    """Extract features of the named images, the database's rows in order, into it; images that have theirs are skipped.

    Images larger than max_image_size are shrunk first; keypoints are in pixels of the full image.
    """

    def features_of(row: int) -> Features:
        grey = read_grey_image(images / names[row])
        return even_sift(grey, settings.max_features, settings.max_image_size, _MIN_CONTRAST)

    sift = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        rows = [row for row in range(len(names)) if not opened.exists_keypoints(image_id(row))]
        described = in_parallel(features_of, rows)
        for row, features in zip(rows, described, strict=True):
            with pycolmap.DatabaseTransaction(opened):
                opened.write_keypoints(image_id(row), features.px)
                descriptors = pycolmap.FeatureDescriptors(data=features.descriptors, type=sift)
                opened.write_descriptors(image_id(row), descriptors)
            report(row + 1)
