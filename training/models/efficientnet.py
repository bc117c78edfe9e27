"""EfficientNet-B0 (Tan and Le, 2019) with torchvision's module names, batch-norm eps (1e-5) and symmetric padding,
so that torchvision's weights load as they are and give the same outputs."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

HEAD_CHANNELS = 1280


class StageSpec(NamedTuple):
    expand: int
    kernel: int
    stride: int
    channels: int
    blocks: int


STAGES = (
    StageSpec(1, 3, 1, 16, 1),
    StageSpec(6, 3, 2, 24, 2),
    StageSpec(6, 5, 2, 40, 2),
    StageSpec(6, 3, 2, 80, 3),
    StageSpec(6, 5, 1, 112, 3),
    StageSpec(6, 5, 2, 192, 4),
    StageSpec(6, 3, 1, 320, 1),
)
# Where `features` has the maps of 1/8 and 1/16 of the image: 28x28 and 14x14 for 224x224.
REDUCTION_8, REDUCTION_16 = 3, 5
REDUCTION_8_CHANNELS, REDUCTION_16_CHANNELS = 40, 112


def conv_norm(
    channels_in: int, channels: int, kernel: int, stride: int = 1, *, groups: int = 1, activation: bool = True
) -> nn.Sequential:
    """Convolution with symmetric padding, batch norm and (option) SiLU."""
    conv = nn.Conv2d(channels_in, channels, kernel, stride, padding=kernel // 2, groups=groups, bias=False)
    layers: list[nn.Module] = [conv, nn.BatchNorm2d(channels)]
    if activation:
        layers.append(nn.SiLU(inplace=True))
    return nn.Sequential(*layers)


class SqueezeExcitation(nn.Module):
    """Scales channels (B, C, H, W) by a gate computed from their means."""

    def __init__(self, channels: int, squeezed: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(channels, squeezed, 1)
        self.fc2 = nn.Conv2d(squeezed, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        gate = nn.functional.silu(self.fc1(x.mean((2, 3), keepdim=True)))
        return x * torch.sigmoid(self.fc2(gate))


class MBConv(nn.Module):
    """Inverted bottleneck; in training its residual branch is dropped a sample with `drop_probability`."""

    def __init__(self, channels_in: int, spec: StageSpec, stride: int, drop_probability: float) -> None:
        super().__init__()
        expanded = channels_in * spec.expand
        layers: list[nn.Module] = [conv_norm(channels_in, expanded, 1)] if spec.expand > 1 else []
        layers += [
            conv_norm(expanded, expanded, spec.kernel, stride, groups=expanded),
            SqueezeExcitation(expanded, max(1, channels_in // 4)),
            conv_norm(expanded, spec.channels, 1, activation=False),
        ]
        self.block = nn.Sequential(*layers)
        self.residual = stride == 1 and channels_in == spec.channels
        self.drop_probability = drop_probability

    def forward(self, x: Tensor) -> Tensor:
        y = self.block(x)
        if not self.residual:
            return y
        if self.training and self.drop_probability > 0:
            keep = 1.0 - self.drop_probability
            y = y * torch.empty(len(y), 1, 1, 1, dtype=y.dtype, device=y.device).bernoulli_(keep) / keep
        return x + y


class EfficientNetB0(nn.Module):
    """Images (B, 3, H, W) to feature maps (`maps`) or ImageNet logits (`forward`).

    `stochastic_depth`: drop probability of the last block's residual branch, rising linearly from 0 at the first.
    """

    def __init__(self, stochastic_depth: float = 0.2) -> None:
        super().__init__()
        features: list[nn.Module] = [conv_norm(3, 32, 3, 2)]
        channels_in, index, total = 32, 0, sum(spec.blocks for spec in STAGES)
        for spec in STAGES:
            blocks = []
            for i in range(spec.blocks):
                drop = stochastic_depth * index / total
                blocks.append(MBConv(channels_in, spec, spec.stride if i == 0 else 1, drop))
                channels_in, index = spec.channels, index + 1
            features.append(nn.Sequential(*blocks))
        features.append(conv_norm(channels_in, HEAD_CHANNELS, 1))
        self.features = nn.Sequential(*features)
        self.avgpool = nn.AdaptiveAvgPool2d(1)
        self.classifier = nn.Sequential(nn.Dropout(0.2), nn.Linear(HEAD_CHANNELS, 1000))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def maps(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """The maps (B, 40, H/8, W/8) and (B, 112, H/16, W/16); the layers after them don't run."""
        map_8 = self.features[: REDUCTION_8 + 1](image_B3HW)
        map_16 = self.features[REDUCTION_8 + 1 : REDUCTION_16 + 1](map_8)
        return map_8, map_16

    def forward(self, image_B3HW: Tensor) -> Tensor:
        return self.classifier(self.avgpool(self.features(image_B3HW)).flatten(1))
