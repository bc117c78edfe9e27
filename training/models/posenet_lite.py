"""PN-Lite: a mixture of poses on whitened features of a frozen EfficientNet-Lite0.

Covariances are of poses in the map frame: rotation (rad) first, then position (m), of errors `true rotation =
exp(rotation) estimated rotation`, as in the tables of poses.
"""

from pathlib import Path

import torch
from scipy.special import fdtri
from torch import Tensor, nn

from groundwalk.scoring.errors import BOUND_95
from groundwalk.training.models.anchored_mixture import OUTPUTS, PoseMixture
from groundwalk.training.models.efficientnet_lite import MAP_CHANNELS, EfficientNetLite0, load_lite0
from groundwalk.training.models.regressor import FrozenRegressor, SceneFrames
from groundwalk.training.poses import PoseBatch, rotation_vector
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
_MIN_FRAMES = 3  # from which on errors of three axes have a covariance
_QUANTILE = 0.9
_CHI2_QUANTILE = 6.25  # of three degrees of freedom at _QUANTILE
_FACTORS = (0.01, 100.0)


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


def resized(covariance_B66: Tensor, sd_B2: Tensor) -> Tensor:
    """Covariances with these root mean square errors, in rotation and in position, and the shapes and correlations
    that they had."""
    squares = covariance_B66.diagonal(dim1=1, dim2=2).unflatten(1, (2, 3)).sum(-1)
    by = (sd_B2 / squares.sqrt()).repeat_interleave(3, dim=1)
    return by[:, None] * covariance_B66 * by[..., None]


def calibration_factors(answers: PoseBatch, truth: PoseBatch) -> Tensor:
    """By what to multiply the covariances' rotation and position parts, (2,), so that nine in ten held-out frames lie
    within their bounds of that size, and for how little so many frames say of others (`widening`)."""
    assert answers.covariance_B66 is not None
    covariance = answers.covariance_B66.double()
    factors = []
    rotation = rotation_vector(answers.quaternion_B4, truth.quaternion_B4)
    for i, error in enumerate((rotation, truth.position_B3 - answers.position_B3)):
        block = covariance[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        squared = (error.double() * torch.linalg.solve(block, error.double())).sum(-1)
        factors.append((torch.quantile(squared, _QUANTILE) / _CHI2_QUANTILE).clamp(*_FACTORS))
    return torch.stack(factors).float() * widening(len(truth.position_B3))


def widening(frames: int) -> float:
    """By what 95 % bounds of three numbers grow since their variances are known from so many frames only: those of
    Hotelling's distribution over those of chi square. Fewer than three frames count as three."""
    n = max(frames, _MIN_FRAMES)
    return float(3 * n / (n - 2) * fdtri(3, n - 2, 0.95) / BOUND_95)


class CovarianceScale(nn.Module):
    """Scales covariances (B, 6, 6) by what held-out frames say of them."""

    factor: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("factor", torch.ones(2))  # rotation, position

    def forward(self, covariance_B66: Tensor) -> Tensor:
        by = self.factor.repeat_interleave(3).sqrt()
        return by[:, None] * covariance_B66 * by

    def fit(self, answers: PoseBatch, truth: PoseBatch) -> None:
        """Make the scale fit these answers too, which were made with the scale as it is."""
        self.factor *= calibration_factors(answers, truth).to(self.factor)


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
        widths = torch.tensor(self.widths, device=scales.device)
        self.whitening.fit(torch.cat(parts, dim=1), scales.repeat_interleave(widths))

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
