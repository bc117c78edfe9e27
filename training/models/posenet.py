"""PN: PoseNet on ResNet-34 with log-quaternions (Kendall and Cipolla, 2017; Brahmbhatt et al., 2018). ResNet-34 (He et
al., 2016) has torchvision's module names, so that torchvision's weights load as they are."""

import torch
from torch import Tensor, nn

from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.poses import PoseBatch, exp_quaternion, log_quaternion
from groundwalk.training.regressor_settings import PoseNetSettings

STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))  # channels and blocks of layer1 .. layer4
FEATURES = 512
_HIDDEN = 2048


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut, which is a strided 1x1 convolution where the shape changes."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module | None = None
        if stride != 1 or channels_in != channels:
            strided = nn.Conv2d(channels_in, channels, 1, stride, bias=False)
            self.downsample = nn.Sequential(strided, nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(x)) + shortcut)


class ResNet34(nn.Module):
    """Images (B, 3, H, W) to features (B, 512): torchvision's without its classifier `fc`."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        channels_in = 64
        for index, (channels, blocks) in enumerate(STAGES, start=1):
            stride = 1 if index == 1 else 2
            layer = [BasicBlock(channels_in, channels, stride)]
            layer += [BasicBlock(channels, channels, 1) for _ in range(blocks - 1)]
            self.add_module(f"layer{index}", nn.Sequential(*layer))
            channels_in = channels
        self.avgpool = nn.AdaptiveAvgPool2d(1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, BasicBlock):
                # Every block starts as its shortcut: a network from scratch is then shallow at first and trains
                # faster (Goyal et al., 2017); loaded weights replace this.
                nn.init.zeros_(module.bn2.weight)

    def forward(self, image_B3HW: Tensor) -> Tensor:
        x = self.maxpool(self.relu(self.bn1(self.conv1(image_B3HW))))
        for index in range(1, len(STAGES) + 1):
            x = self.get_submodule(f"layer{index}")(x)
        return self.avgpool(x).flatten(1)


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
        rotation_loss = nn.functional.l1_loss(log_q, log_quaternion(true_quaternion))
        return self.loss_weights(nn.functional.l1_loss(position, true_position), rotation_loss)
