"""The stage import: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.capture_import.formats import FORMATS
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy

STAGE = Stage(
    name="import",
    version=33,
    settings=ImportSettings,
    needs=(),
    run=Lazy("groundwalk.capture_import.stage:run"),
    help="Import: phone captures to frames with intrinsics and VIO poses.",
    reads_captures=True,
    files=lambda settings: [f for f in (settings.face_model if settings.blur else "", settings.blur_boxes) if f],
    plugins=lambda settings: FORMATS.versions(None if settings.format == "auto" else [settings.format]),
)
