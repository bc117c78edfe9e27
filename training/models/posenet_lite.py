"""PN-Lite: a mixture of poses on whitened features of a frozen EfficientNet-Lite0."""

from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.training.models.anchored_mixture import OUTPUTS, PoseMixture
from groundwalk.training.models.efficientnet_lite import MAP_CHANNELS, EfficientNetLite0, load_lite0
from groundwalk.training.models.regressor import FrozenRegressor, SceneFrames
from groundwalk.training.models.uncertainty import CovarianceScale, resized
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import LiteSettings, RegressorSettings

WIDTH = 256  # features after whitening, and in the hidden layers
COMPONENTS = 32  # poses of the mixture
# Rows and columns to which the maps of 1/16 and 1/32 are pooled.
CELLS_16, CELLS_32 = (5, 7), (4, 5)
_CELLS = CELLS_16[0] * CELLS_16[1], CELLS_32[0] * CELLS_32[1]
_POOLED = [channels * cells for channels, cells in zip(MAP_CHANNELS, _CELLS, strict=True)]
_CHANNEL_WIDTHS = 48, 128  # of the maps' 112 and 320 channels
_REGULARISATION = 0.05  # of the whitening, in parts of the largest variance
_SMALLEST = 1e-6


class ChannelComponents(nn.Module):
    """The cells of a map (B, channels * cells) to the first principal components of its channels (B, width * cells),
    the same for all cells: a whitening of these has that much fewer weights."""

    axes: Tensor

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.register_buffer("axes", torch.zeros(channels, width))

    def fit(self, features_NF: Tensor) -> None:
        """Without the cells' means over the images, which the whitening takes away."""
        cells = (features_NF - features_NF.mean(dim=0)).unflatten(1, (len(self.axes), -1)).transpose(1, 2)
        by_cell = cells.reshape(-1, len(self.axes)).double()
        self.axes.copy_(torch.linalg.eigh(by_cell.T @ by_cell)[1].flip(1)[:, : self.axes.shape[1]])

    def forward(self, features_BF: Tensor) -> Tensor:
        return (features_BF.unflatten(1, (len(self.axes), -1)).transpose(1, 2) @ self.axes).flatten(1)


class Whitening(nn.Module):
    """Features (B, F) to their first principal components (B, width), with about unit variance over the training
    images. A tenth of the numbers, so that a head trains in seconds."""

    mean: Tensor
    axes: Tensor

    def __init__(self, features: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("axes", torch.zeros(features, width))

    def fit(self, features_NF: Tensor, scale_F: Tensor) -> None:
        """`scale_F`: what each feature is divided by first. Features that don't vary give zeros."""
        self.mean.copy_(features_NF.mean(dim=0))
        scaled_NF = (features_NF - self.mean) / scale_F
        # The images are fewer than the features: eigenvectors by way of their products.
        variance, vectors = torch.linalg.eigh(scaled_NF.double() @ scaled_NF.double().T)
        variance, vectors = variance.flip(0)[: self.width].clamp_min(0), vectors.flip(1)[:, : self.width]
        length = variance.sqrt().clamp_min(_SMALLEST)
        axes = scaled_NF.double().T @ vectors / length
        sd = ((variance + _REGULARISATION * variance[0]) / len(features_NF)).sqrt().clamp_min(_SMALLEST)
        self.axes.zero_()
        self.axes[:, : len(variance)] = (axes / sd / scale_F.double()[:, None]).float()
        whole = self(features_NF).std()
        self.axes /= whole if whole > _SMALLEST else 1.0

    def forward(self, features_BF: Tensor) -> Tensor:
        return (features_BF - self.mean) @ self.axes


class PoseNetLite(FrozenRegressor):
    """One scene's poses: a whitened summary of a frozen EfficientNet-Lite0's maps, two hidden layers, a mixture."""

    recordable = True

    def __init__(
        self,
        settings: LiteSettings,
        scenes: int = 1,
        outdoor: bool = False,
        width: int = WIDTH,
        components: int = COMPONENTS,
    ) -> None:
        super().__init__()
        dropout = settings.dropout
        self.backbone = EfficientNetLite0().requires_grad_(False)
        self.channels = nn.ModuleList(map(ChannelComponents, MAP_CHANNELS, _CHANNEL_WIDTHS))
        self.widths = [width * cells for width, cells in zip(_CHANNEL_WIDTHS, _CELLS, strict=True)]
        self.whitening = Whitening(sum(self.widths), width)
        self.frames = SceneFrames(1)
        self.mixture = PoseMixture(1, components)
        self.covariance_scale = CovarianceScale()
        first, last, hidden = nn.Linear(width, width), nn.Linear(width, components * OUTPUTS), nn.Linear(width, width)
        with torch.no_grad():
            last.weight *= 0.3  # the anchors themselves are a good first answer
        layers = nn.Dropout(dropout / 2), first, nn.GELU(), nn.Dropout(dropout), hidden, nn.GELU(), nn.Dropout(dropout)
        self.head = nn.Sequential(*layers, last)

    def initialise(self, poses: PoseBatch, settings: RegressorSettings, downloads: Path) -> str:
        if not isinstance(settings, LiteSettings):
            raise TypeError(f"{type(settings).__name__} isn't a LiteSettings")
        origin = load_lite0(self.backbone, settings.weights)
        self.frames.fit(poses, normalise_position=True, centre_rotation=False)
        self.mixture.fit(*self.frames.from_map(poses), poses.scene_B)
        return origin

    def train(self, mode: bool = True) -> "PoseNetLite":
        super().train(mode)
        self.backbone.eval()
        return self

    @torch.no_grad()
    def features(self, image_B3HW: Tensor) -> Tensor:
        """The cells (B, sum(_POOLED)) of the backbone's maps of 1/16 and 1/32, which are in float32: bfloat16 slows
        depthwise convolutions down."""
        with torch.autocast(image_B3HW.device.type, enabled=False):
            map_16, map_32 = self.backbone.maps(image_B3HW)
        cells = nn.functional.adaptive_avg_pool2d(map_16, CELLS_16), nn.functional.adaptive_avg_pool2d(map_32, CELLS_32)
        return torch.cat([c.flatten(1) for c in cells], dim=1)

    def reduced(self, features: Tensor) -> Tensor:
        with torch.autocast(features.device.type, enabled=False):
            return self.whitening(torch.cat(self._components(features), dim=1))

    def _components(self, pooled: Tensor) -> list[Tensor]:
        parts = pooled.float().split(_POOLED, dim=1)
        return [channels(part) for channels, part in zip(self.channels, parts, strict=True)]

    def fit_features(self, features: Tensor) -> None:
        for channels, part in zip(self.channels, features.float().split(_POOLED, dim=1), strict=True):
            assert isinstance(channels, ChannelComponents)
            channels.fit(part)
        parts = self._components(features)
        scales = torch.stack([part.std().clamp_min(_SMALLEST) * part.shape[1] ** 0.5 for part in parts])
        self.whitening.fit(
            torch.cat(parts, dim=1), scales.repeat_interleave(torch.tensor(self.widths, device=scales.device))
        )

    def answer(self, reduced: Tensor) -> PoseBatch:
        """The poses in the map frame. Covariances have the shape of the mixture's, and the size of `error_sizes`."""
        outputs = self.head(reduced)
        scene = torch.zeros(len(outputs), dtype=torch.long, device=outputs.device)
        with torch.autocast(outputs.device.type, enabled=False):
            components = self.mixture.decode(outputs.float(), scene)
            answer = self.mixture.poses(components, scene)
            sd = self.mixture.error_sizes(components, answer)
        assert answer.covariance_B66 is not None
        covariance = self.covariance_scale(resized(answer.covariance_B66, sd))
        poses = self.frames.to_map(answer.position_B3, answer.quaternion_B4, scene)
        scale = self.frames.scale[scene].expand(-1, 3)
        units = torch.cat([torch.ones_like(scale), scale], dim=1)
        return poses._replace(covariance_B66=covariance * units[:, None] * units[..., None])

    def feature_loss(self, reduced: Tensor, poses: PoseBatch) -> Tensor:
        """The mixture's negative log-likelihood."""
        outputs = self.head(reduced)
        position, quaternion = self.frames.from_map(poses)
        with torch.autocast(outputs.device.type, enabled=False):
            return self.mixture.loss(outputs.float(), position, quaternion, poses.scene_B)

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        self.covariance_scale.fit(answers, truth)
