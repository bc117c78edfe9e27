"""The stage train: its version, settings and inputs; what runs it is imported when it is to run."""

from groundwalk.store.definition import Stage
from groundwalk.store.registry import Lazy
from groundwalk.training.regressor_settings import weights_file
from groundwalk.training.regressors import REGRESSORS
from groundwalk.training.settings import TrainSettings

STAGE = Stage(
    name="train",
    version=20,
    settings=TrainSettings,
    needs=("import", "align"),
    run=Lazy("groundwalk.training.stage:run"),
    help="Train absolute pose regressors, and predict the pose of every frame. A group of scenes shares one network.",
    files=lambda settings: (
        *settings.predictions,
        *filter(None, (weights_file(settings.regressors[m]) for m in settings.models if m in settings.regressors)),
    ),
    plugins=lambda settings: REGRESSORS.versions(settings.models),
    reads_images=lambda settings: True,
    # Small images, and a model's checkpoints: weights and twice as much of its optimiser's, older and newer.
    space_bytes=lambda settings, frames: 5 * frames * settings.resize**2 + (600 << 20) * len(settings.models),
)
