"""PN: PoseNet on ResNet-34 with log-quaternions (Kendall and Cipolla, 2017; Brahmbhatt et al., 2018)."""

import torch
from torch import Tensor, nn

from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.models.resnet import FEATURES, ResNet34
from groundwalk.training.poses import PoseBatch, exp_quaternion, log_quaternion
from groundwalk.training.regressor_settings import PoseNetSettings

_HIDDEN = 2048


class PoseNet(BackboneRegressor):
    """One scene's poses: features 512 -> 2048, ReLU, dropout, then position (3) and log-quaternion (3)."""

    recordable = True
    backbone_url = "https://download.pytorch.org/models/resnet34-b627a593.pth"

    def __init__(self, settings: PoseNetSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        self.backbone: ResNet34 = ResNet34()
        self.hidden = nn.Linear(FEATURES, _HIDDEN)
        self.position = nn.Linear(_HIDDEN, 3)
        self.rotation = nn.Linear(_HIDDEN, 3)
        # A module, so that eval() turns it off; the functional form stays on at test time.
        self.dropout = nn.Dropout(settings.dropout)
        for layer in (self.hidden, self.position, self.rotation):
            nn.init.kaiming_normal_(layer.weight)
            nn.init.zeros_(layer.bias)

    def _regress(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        features = self.backbone(image_B3HW)
        # bfloat16 resolves 1 part in 256, too coarse for positions: the head computes in float32.
        with torch.autocast(image_B3HW.device.type, enabled=False):
            hidden = self.dropout(torch.relu(self.hidden(features.float())))
            return self.position(hidden), self.rotation(hidden)

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        position, log_q = self._regress(image_B3HW)
        scene = torch.zeros(len(position), dtype=torch.long, device=position.device)
        return self.frames.to_map(position, exp_quaternion(log_q), scene)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """L1 of position and of log-quaternion, on the hemisphere w >= 0."""
        position, log_q = self._regress(image_B3HW)
        true_position, true_quaternion = self.frames.from_map(poses)
        return self.loss_weights(
            nn.functional.l1_loss(position, true_position),
            nn.functional.l1_loss(log_q, log_quaternion(true_quaternion)),
        )
