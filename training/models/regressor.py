"""What every pose regressor offers to the loop and the exporter, and a base for those with a pretrained backbone."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from groundwalk.training.poses import PoseBatch, canonical, conjugate, multiply
from groundwalk.training.regressor_settings import BackboneSettings, RegressorSettings
from groundwalk.training.weights import load_first_weights


class LearnedWeights(nn.Module):
    """Sums a position and a rotation loss as exp(-sx) Lx + sx + exp(-sq) Lq + sq with learned sx and sq, the
    logarithms of the two losses' variances (Kendall and Cipolla, 2017)."""

    def __init__(self, sx: float, sq: float) -> None:
        super().__init__()
        self.sx = nn.Parameter(torch.tensor(float(sx)))
        self.sq = nn.Parameter(torch.tensor(float(sq)))

    def forward(self, position_loss: Tensor, rotation_loss: Tensor) -> Tensor:
        position = torch.exp(-self.sx) * position_loss + self.sx
        return position + torch.exp(-self.sq) * rotation_loss + self.sq


class SceneFrames(nn.Module):
    """The frame that the network regresses in, one a scene: the map frame shifted, scaled and turned.

        position_net = (position_map - centre) / scale        quaternion_net = turn^-1 quaternion_map

    Without `fit` it is the map frame itself. Held as buffers, so that a model file is complete.
    """

    centre: Tensor
    scale: Tensor
    turn: Tensor

    def __init__(self, scenes: int) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(scenes, 3))
        self.register_buffer("scale", torch.ones(scenes, 1))
        self.register_buffer("turn", torch.tensor([[0.0, 0.0, 0.0, 1.0]]).repeat(scenes, 1))

    def fit(self, poses: PoseBatch, normalise_position: bool, centre_rotation: bool) -> None:
        """Take the frame of each scene from its training poses.

        `normalise_position`: zero mean and unit standard deviation, one scale for all axes so that a metre counts
        the same up and sideways. `centre_rotation`: identity is the mean rotation (Gramkow's), which puts the
        half-turn where a log-quaternion jumps as far from the poses as can be.
        """
        for scene in range(len(self.centre)):
            mine = poses.scene_B == scene
            position, quaternion = poses.position_B3[mine].double(), poses.quaternion_B4[mine].double()
            if normalise_position:
                self.centre[scene] = position.mean(0)
                self.scale[scene] = (position - position.mean(0)).square().mean().sqrt().clamp_min(1e-3)
            if centre_rotation:
                # The eigenvector of the largest eigenvalue has the largest sum of squared dot products.
                self.turn[scene] = canonical(torch.linalg.eigh(quaternion.T @ quaternion).eigenvectors[:, -1])

    def from_map(self, poses: PoseBatch) -> tuple[Tensor, Tensor]:
        """Positions (B, 3) and quaternions (B, 4) in the network's frame."""
        index = poses.scene_B
        position = (poses.position_B3 - self.centre[index]) / self.scale[index]
        return position, multiply(conjugate(self.turn[index]), poses.quaternion_B4)

    def to_map(self, position_B3: Tensor, quaternion_B4: Tensor, scene_B: Tensor) -> PoseBatch:
        """The poses in the map frame (m, canonical quaternions) of network outputs."""
        position = position_B3 * self.scale[scene_B] + self.centre[scene_B]
        return PoseBatch(position, canonical(multiply(self.turn[scene_B], quaternion_B4)), scene_B)


class PoseRegressor(nn.Module, ABC):
    """Images (B, 3, H, W), normalised as ImageNet's, to camera poses in the map frames of one scene or several.

    The training loop calls `loss` and `forward`, and nothing else has to be there; the other methods have answers that
    suit a network without pretrained parts.
    """

    recordable: ClassVar[bool] = False
    """`loss` (of a FrozenRegressor `feature_loss`) does the same for all batches of a shape and never looks at a
    tensor's value in Python, so that a GPU can run it as one recorded CUDA graph."""

    @abstractmethod
    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        """The estimated poses, in the map frame of the scene that the model picks."""

    @abstractmethod
    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """The training loss, a scalar."""

    def initialise(self, poses: PoseBatch, settings: RegressorSettings, downloads: Path) -> str:
        """Called once before training, with the poses of all training frames; `downloads` keeps what is fetched.

        Returns where the first weights come from, for the model card.
        """
        return "scratch"

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        """Called once after training with the answers to the held-out frames, to scale covariances by."""

    def undecayed(self) -> list[nn.Parameter]:
        """The parameters that the L2 penalty leaves alone."""
        return []

    def curves(self) -> dict[str, float]:
        """What the learning curves hold beside the errors: columns sx and sq of train.history, or nothing."""
        return {}

    def layers(self) -> str:
        """What a reader of the model card wants to know about sizes that can be set."""
        return ""

    def parameter_count(self) -> int:
        """Numbers that training can change, the loss weights with them."""
        return sum(p.numel() for p in self.parameters())

    def bytes(self) -> int:
        """Bytes of the float32 weights: parameters and the batch norms' running statistics."""
        floats = [*self.parameters(), *(b for b in self.buffers() if b.is_floating_point())]
        return sum(t.numel() for t in floats) * 4


class FrozenRegressor(PoseRegressor):
    """Base of regressors whose backbone isn't trained: its features are computed once, kept on disk, and used in every
    epoch. `forward` and `loss` go from images to features and on."""

    @abstractmethod
    def features(self, image_B3HW: Tensor) -> Tensor:
        """What the frozen layers make of images, with one row an image."""

    @abstractmethod
    def fit_features(self, features: Tensor) -> None:
        """Called once before training, with the features of all training images."""

    @abstractmethod
    def reduced(self, features: Tensor) -> Tensor:
        """The features as `answer` and `feature_loss` take them: after the steps that `fit_features` fixes, which are
        computed once for all images."""

    @abstractmethod
    def answer(self, reduced: Tensor) -> PoseBatch:
        """`forward`, from reduced features on."""

    @abstractmethod
    def feature_loss(self, reduced: Tensor, poses: PoseBatch) -> Tensor:
        """`loss`, from reduced features on."""

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        return self.answer(self.reduced(self.features(image_B3HW)))

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        return self.feature_loss(self.reduced(self.features(image_B3HW)), poses)


class BackboneRegressor(PoseRegressor):
    """Base of regressors with an ImageNet backbone, learned loss weights, and a frame of their own in each scene.

    `backbone` has torchvision's module names, and `backbone_url` is torchvision's file of its weights.
    """

    backbone: nn.Module
    backbone_url: str

    def __init__(self, settings: BackboneSettings, scenes: int, outdoor: bool) -> None:
        super().__init__()
        self.scenes = scenes
        self.frames = SceneFrames(scenes)
        # Without a recipe's own, those that MS-T's authors begin with.
        first = settings.training.loss_weights or ((-3.0, -6.5) if outdoor else (0.0, -3.0))
        self.loss_weights = LearnedWeights(*first)

    def initialise(self, poses: PoseBatch, settings: RegressorSettings, downloads: Path) -> str:
        if not isinstance(settings, BackboneSettings):
            raise TypeError(f"{type(settings).__name__} isn't a BackboneSettings")
        origin = load_first_weights(self.backbone, self.backbone_url, settings.weights, downloads)
        normalise = settings.training.normalise
        self.frames.fit(poses, normalise, normalise)
        return origin

    def undecayed(self) -> list[nn.Parameter]:
        """The loss weights, which the penalty would pull to equal variances."""
        return list(self.loss_weights.parameters())

    def curves(self) -> dict[str, float]:
        return {"sx": self.loss_weights.sx.item(), "sq": self.loss_weights.sq.item()}
