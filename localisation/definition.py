"""The stage localise: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.localisation.localisers import LOCALISERS
from groundwalk.localisation.settings import LocaliseSettings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy

STAGE = Stage(
    name="localise",
    version=9,
    settings=LocaliseSettings,
    needs=("import", "sfm", "align"),
    run=Lazy("groundwalk.localisation.stage:run"),
    help="Build maps of points from the training frames, and localise the other frames in them. A group of scenes has "
    "its scenes' maps.",
    plugins=lambda settings: LOCALISERS.versions(settings.models),
    reads_images=lambda settings: True,
    space_bytes=lambda settings, frames: (32 << 20) + frames * 100_000,
)
