"""Settings of the regressors, and their recipes of training."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from pydantic import Field

from groundwalk.store import Settings

Jitter = tuple[float, float, float, float]  # brightness, contrast, saturation and hue
Turn = tuple[float, float, float]  # yaw, pitch and roll, degrees
TURNED = (8.0, 3.0, 4.0)  # yaw, pitch and roll, degrees, of images that are few


@dataclass(frozen=True)
class Recipe:
    """How a regressor is trained beside what its settings say.

    weight_decay: Adam's L2 penalty, or with `decoupled` AdamW's decay. schedule: the learning rate stays, falls to a
    tenth at each third of the epochs, or to zero along a cosine. clip_gradient: largest norm of a step's gradient, 0
    for any. jitter: largest change of brightness, contrast, saturation and hue. turn_deg: largest yaw, pitch and roll
    by which a training image is turned together with its pose; None: a random crop keeps the image's pose, as in the
    paper. loss_weights: first log-variances of the position and the rotation loss, None: by whether the scene is
    outdoors. normalise: positions have zero mean and unit deviation for the network, and rotations are relative to the
    mean training one. bfloat16: precision auto may choose it.
    """

    weight_decay: float = 5e-4
    decoupled: bool = False
    adam_eps: float = 1e-8
    schedule: Literal["constant", "thirds", "cosine"] = "constant"
    warmup_epochs: float = 0
    clip_gradient: float = 0
    jitter: Jitter = (0, 0, 0, 0)
    turn_deg: Turn | None = None
    loss_weights: tuple[float, float] | None = (0.0, -3.0)
    normalise: bool = True
    bfloat16: bool = True


class RegressorSettings(Settings):
    """How one regressor is trained. A class of its own defaults may have recipes of its own."""

    recipes: ClassVar[Mapping[str, Recipe]] = {"published": Recipe()}

    epochs: int = Field(300, gt=0, description="passes over the training frames")
    batch: int = Field(64, gt=1, description="images a step")
    learning_rate: float = Field(1e-4, gt=0, description="Adam's learning rate after warming up")
    jitter: Jitter | None = Field(
        None, description="colour jitter: brightness, contrast, saturation, hue; without it the recipe's"
    )

    @property
    def training(self) -> Recipe:
        """The recipe that these settings name."""
        recipe = self.recipes[getattr(self, "recipe", "published")]
        return recipe if self.jitter is None else replace(recipe, jitter=self.jitter)


_DROPOUT = "share of the head's or the transformers' features left out in training"
_WEIGHTS = (
    "the backbone's first weights: auto (those of an installed package or downloaded ImageNet weights, else scratch),"
    " imagenet (downloaded), scratch, or a file with their state dict, relative to the data folder"
)


class BackboneSettings(RegressorSettings):
    """The same of a regressor with a pretrained backbone."""

    recipe: Literal["published", "few_images"] = Field(
        "published",
        description="published: as its authors train it; few_images: for some hundred images and first weights by"
        " chance, with images turned together with their poses, and a rate that warms up and falls along a cosine",
    )
    dropout: float = Field(0.5, ge=0, lt=1, description=_DROPOUT)
    weights: str = Field("auto", description=_WEIGHTS)


class PoseNetSettings(BackboneSettings):
    """PN: MapNet's authors' settings for PoseNet."""

    recipes: ClassVar[Mapping[str, Recipe]] = {
        "published": Recipe(),
        "few_images": Recipe(
            weight_decay=1e-5,
            schedule="cosine",
            warmup_epochs=3,
            clip_gradient=5,
            jitter=(0.3, 0.3, 0.3, 0.03),
            turn_deg=TURNED,
            loss_weights=(-2.0, -3.0),
        ),
    }


class MSTransformerSettings(BackboneSettings):
    """MS-T: its authors' settings for outdoor scenes."""

    recipes: ClassVar[Mapping[str, Recipe]] = {
        "published": Recipe(
            weight_decay=1e-4,
            adam_eps=1e-10,
            schedule="thirds",
            jitter=(0.5, 0.5, 0.5, 0.2),
            loss_weights=None,
            normalise=False,
        ),
        "few_images": replace(
            PoseNetSettings.recipes["few_images"], weight_decay=1e-6, warmup_epochs=6, clip_gradient=1
        ),
    }

    epochs: int = Field(600, gt=0, description="passes over the training frames")
    batch: int = Field(8, gt=1, description="images a step")
    dropout: float = Field(0.1, ge=0, lt=1, description=_DROPOUT)
    layers: int = Field(6, gt=0, description="encoder layers, and decoder layers, of each transformer")


class LiteSettings(RegressorSettings):
    """A head on features of EfficientNet-Lite0, which are computed once, of turned copies of each image, too."""

    recipes: ClassVar[Mapping[str, Recipe]] = {
        "published": Recipe(
            weight_decay=1e-2,
            decoupled=True,
            schedule="cosine",
            warmup_epochs=6,
            clip_gradient=1,
            jitter=(0.3, 0.3, 0.3, 0.03),
            turn_deg=(45, 3, 3),
            bfloat16=False,
        )
    }

    epochs: int = Field(40, gt=0, description="passes over the training frames")
    batch: int = Field(128, gt=1, description="images a step")
    learning_rate: float = Field(2e-3, gt=0, description="Adam's learning rate after warming up")
    dropout: float = Field(0.3, ge=0, lt=1, description=_DROPOUT)
    weights: str = Field(
        "auto",
        description="EfficientNet-Lite0's weights: auto (those of the installed package), or a file with their state"
        " dict, relative to the data folder",
    )


def weights_file(settings: RegressorSettings) -> str | None:
    """The file that the setting `weights` names, relative to the data folder; None where it names none."""
    weights = settings.weights if isinstance(settings, BackboneSettings | LiteSettings) else "auto"
    return None if weights in ("auto", "imagenet", "scratch") else weights
