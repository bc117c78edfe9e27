"""CoordiNet: PN whose head knows where in the image a feature is and states its own uncertainty (Moreau et al.,
"CoordiNet: uncertainty-aware pose regressor for reliable vehicle localization", WACV 2022).

Its parts on PN's ResNet-34 instead of EfficientNet-B3: coordinate channels before the head's convolution, pooling
weighted by a confidence that the network learns, and a heteroscedastic loss.
"""

import torch
from torch import Tensor, nn

from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.models.resnet import FEATURES, ResNet34
from groundwalk.training.models.uncertainty import CovarianceScale, diagonal_in_map, rotation_vector
from groundwalk.training.poses import PoseBatch, exp_quaternion
from groundwalk.training.regressor_settings import PoseNetSettings

_CHANNELS = 512
_LOG_SD = (-7.0, 3.0)


class CoordiNet(BackboneRegressor):
    """One scene's poses with standard deviations by axis."""

    recordable = True
    backbone_url = "https://download.pytorch.org/models/resnet34-b627a593.pth"

    def __init__(self, settings: PoseNetSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        self.backbone: ResNet34 = ResNet34()
        self.convolution = nn.Conv2d(FEATURES + 2, _CHANNELS, 1)
        self.pose = nn.Conv2d(_CHANNELS + 2, 6 + 6 + 1, 1)
        # The first poses are those of the mean frame, as sure as the losses' first variances say.
        nn.init.zeros_(self.pose.weight)
        sx, sq = self.loss_weights.sx.item(), self.loss_weights.sq.item()
        self.pose.bias = nn.Parameter(torch.tensor([0.0] * 6 + [sq] * 3 + [sx] * 3 + [0.0]))
        self.loss_weights.requires_grad_(False)  # the likelihood weighs
        self.covariance_scale = CovarianceScale()

    def _regress(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Position (B, 3), log-quaternion (B, 3), and the logarithms of both errors' deviations, rotation (rad) first
        (B, 6), in the network's frame."""
        maps: Tensor = self.backbone.maps(image_B3HW)
        with torch.autocast(image_B3HW.device.type, enabled=False):
            hidden = torch.relu(self.convolution(with_coordinates(maps.float())))
            out = self.pose(with_coordinates(hidden)).flatten(2)
            pooled = (out[:, :-1] * out[:, -1:].softmax(dim=-1)).sum(dim=-1)
        return pooled[:, :3], pooled[:, 3:6], pooled[:, 6:].clamp(*_LOG_SD)

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        position, log_q, log_sd = self._regress(image_B3HW)
        scene = torch.zeros(len(position), dtype=torch.long, device=position.device)
        answer = self.frames.to_map(position, exp_quaternion(log_q), scene)
        rotation_sd, position_sd = log_sd.exp().split(3, dim=1)
        covariance = diagonal_in_map(self.frames, scene, rotation_sd, position_sd)
        return answer._replace(covariance_B66=self.covariance_scale(covariance))

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        self.covariance_scale.fit(answers, truth)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """The mean negative logarithm of the likelihood, with a Laplace distribution an axis (constants left out)."""
        position, log_q, log_sd = self._regress(image_B3HW)
        true_position, true_quaternion = self.frames.from_map(poses)
        rotation = rotation_vector(exp_quaternion(log_q), true_quaternion)
        error = torch.cat([rotation, true_position - position], dim=1).abs()
        return (2**0.5 * error * (-log_sd).exp() + log_sd).mean()

    def undecayed(self) -> list[nn.Parameter]:
        return list(self.pose.parameters())

    def curves(self) -> dict[str, float]:
        return {}


def with_coordinates(maps_BCHW: Tensor) -> Tensor:
    """The maps and two channels more: where each cell lies, across and down, from -1 to 1 (CoordConv, Liu et al.,
    2018)."""
    batch, _, height, width = maps_BCHW.shape
    down = torch.linspace(-1, 1, height, device=maps_BCHW.device)[:, None].expand(height, width)
    across = torch.linspace(-1, 1, width, device=maps_BCHW.device).expand(height, width)
    return torch.cat([maps_BCHW, torch.stack([across, down]).expand(batch, 2, height, width)], dim=1)
