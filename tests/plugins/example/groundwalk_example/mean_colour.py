"""A pose from the mean colours of an image's cells: no good, but all that a regressor needs."""

import torch
from pydantic import Field
from torch import Tensor, nn

from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import Regressor


class MeanColourSettings(RegressorSettings):
    """Section [train.regressors.mean_colour]."""

    cells: int = Field(4, gt=0, description="cells along each side of the image")


class MeanColour(PoseRegressor):
    """Position, rotation and the logarithm of one variance, linear in the cells' colours."""

    def __init__(self, cells: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.AdaptiveAvgPool2d(cells), nn.Flatten(), nn.Linear(3 * cells * cells, 8))

    def _regress(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        output = self.net(image_B3HW)
        turned = output[:, 3:7] + torch.tensor([0.0, 0.0, 0.0, 1.0], device=output.device)
        return output[:, :3], nn.functional.normalize(turned, dim=-1), output[:, 7]

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        position, quaternion, log_variance = self._regress(image_B3HW)
        scene = torch.zeros(len(position), dtype=torch.long, device=position.device)
        covariance = torch.exp(log_variance)[:, None, None] * torch.eye(6, device=position.device)
        return PoseBatch(position, quaternion, scene, covariance)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """Negative log-likelihood of a Gaussian over all six degrees of freedom."""
        position, quaternion, log_variance = self._regress(image_B3HW)
        aligned = (quaternion * poses.quaternion_B4).sum(dim=-1).abs()
        squared = (position - poses.position_B3).square().sum(dim=-1) + 8 * (1 - aligned)
        return (0.5 * squared * torch.exp(-log_variance) + 3 * log_variance).mean()


def make(settings: MeanColourSettings, scenes: int, outdoor: bool) -> MeanColour:
    return MeanColour(settings.cells)


REGRESSOR = Regressor(
    id="mean_colour",
    label="mean colour",
    meaning="linear in the mean colours of an image's cells",
    colour=(120, 94, 240),
    settings=MeanColourSettings,
    make=make,
    multi_scene=False,
    gives_covariance=True,
)
