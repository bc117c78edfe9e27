"""The stage align: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.alignment.settings import AlignSettings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy

STAGE = Stage(
    name="align",
    version=30,
    settings=AlignSettings,
    needs=("import", "sfm"),
    run=Lazy("groundwalk.alignment.stage:run"),
    help="Ground truth: SfM's model put into a metric map with +y up, checked against the phones' VIO. Metric scale "
    "and vertical come from all sessions together; writes each frame's pose with covariance and quality, where each "
    "session's VIO frame lies, how VIO drifts, and the consistency checks.",
    files=lambda settings: [file for control in settings.controls for file in (control.points, control.images) if file],
    reads_images=lambda settings: bool(settings.rulers) or any(c.dictionary for c in settings.controls),
)
