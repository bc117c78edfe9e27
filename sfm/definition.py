"""The stage sfm: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.sfm.plugins import MAPPERS
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy

STAGE = Stage(
    name="sfm",
    version=62,
    settings=SfmSettings,
    needs=("import",),
    run=Lazy("groundwalk.sfm.stage:run"),
    plugins=lambda settings: MAPPERS.versions([settings.mapper]),
    help="Structure from motion: features, pairs from time, VIO and similar images, checked against VIO; models over "
    "all sessions, one where the images allow it, and their quality.",
    reads_images=lambda settings: True,
    # Keypoints, descriptors and matches, and the images without their lens.
    space_bytes=lambda settings, frames: (32 << 20) + frames * (200_000 + 250 * settings.max_features),
)
