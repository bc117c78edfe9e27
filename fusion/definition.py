"""The stage fuse: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.settings import FuseSettings
from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy

STAGE = Stage(
    name="fuse",
    version=33,
    settings=FuseSettings,
    needs=("import", "align", "localise", "train"),
    run=Lazy("groundwalk.fusion.stage:run"),
    help="Fuse regressors' and structure localisers' predictions with odometry, and measure every method against the "
    "ground truth.",
    plugins=lambda settings: METHODS.versions(settings.methods),
)
