"""DFNet: PN that also learns from rendered views, and to render what it sees (Chen et al., "DFNet: enhance absolute
pose regression with direct feature matching", ECCV 2022).

Views come from the map's points instead of a NeRF, and the network is PN's instead of VGG-16.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from groundwalk.training.models.point_renderer import PointRenderer
from groundwalk.training.models.posenet import PoseNet, loss_weights
from groundwalk.training.models.regressor import MapPoints
from groundwalk.training.poses import PoseBatch, exp_quaternion, log_quaternion, multiply
from groundwalk.training.regressor_settings import DFNetSettings

_LEVELS = {"layer1": 64, "layer2": 128, "layer3": 256}  # of ResNet-34, a quarter to a sixteenth of the image, channels
_HIDDEN, _MATCHED = 64, 128  # channels of the features that are matched
POINTS = 20_000  # of the map, that views are rendered from
_MARGIN = 1.0  # by which an image's features are to be nearer to those of its own view than of another
_VIEW_SHIFT_M, _VIEW_TURN_DEG = 1.0, 10.0  # of views beside a training pose


class DFNet(PoseNet):
    """One scene's poses. In training an image goes with the view of the map at its pose.

    loss = PN's of both + triplet loss of their features + PN's of a view near by, and, after `matching_from` steps,
    how far the image's features are from those of the view at the estimated pose.
    """

    uses_map = True
    recordable = False
    steps: Tensor

    def __init__(self, settings: DFNetSettings, points: int = POINTS) -> None:
        super().__init__(settings.dropout, *loss_weights(settings))
        self.matching_from = settings.matching_from
        self.renderer = PointRenderer(points)
        self.adapters = nn.ModuleList(_adapter(channels) for channels in _LEVELS.values())
        self.register_buffer("steps", torch.zeros((), dtype=torch.long))

    def see_map(self, points: MapPoints) -> None:
        self.renderer.fit(points)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        self.steps += 1
        real, pose = self._features_and_pose(image_B3HW)
        near = self._near(poses)
        with torch.no_grad():
            both = (
                torch.cat(parts)
                for parts in ((poses.position_B3, near.position_B3), (poses.quaternion_B4, near.quaternion_B4))
            )
            views = self.renderer(*both, *image_B3HW.shape[-2:])
        with self._statistics_kept():
            rendered, view_pose = self._features_and_pose(views)
        count = len(image_B3HW)
        total = self._pose_loss(torch.cat([pose, view_pose[:count]]), poses, poses)
        total = total + self._pose_loss(view_pose[count:], near)
        total = total + triplet_loss(real, [level[:count] for level in rendered], _MARGIN)
        if int(self.steps) > self.matching_from:
            total = total + self._matching_loss(real, pose, image_B3HW)
        return total

    def _features_and_pose(self, image_B3HW: Tensor) -> tuple[list[Tensor], Tensor]:
        """Features to match, a tensor a level; position and log-quaternion (B, 6) in the network's frame."""
        maps = self.backbone.levels(image_B3HW)
        with torch.autocast(image_B3HW.device.type, enabled=False):
            matched = [adapt(maps[name].float()) for adapt, name in zip(self.adapters, _LEVELS, strict=True)]
            return matched, torch.cat(self._head(maps["layer4"].float().mean((2, 3))), dim=1)

    def _pose_loss(self, pose: Tensor, *truth: PoseBatch) -> Tensor:
        """PN's loss of network outputs (B, 6)."""
        position, quaternion = (torch.cat(parts) for parts in zip(*map(self.frames.from_map, truth), strict=True))
        l1 = nn.functional.l1_loss
        weighed: Tensor = self.loss_weights(l1(pose[:, :3], position), l1(pose[:, 3:], log_quaternion(quaternion)))
        return weighed

    def _near(self, poses: PoseBatch) -> PoseBatch:
        """Poses up to _VIEW_SHIFT_M along each axis, and up to _VIEW_TURN_DEG about each, from these."""
        shift, turn = 2 * torch.rand(2, *poses.position_B3.shape, device=poses.position_B3.device) - 1
        turned = multiply(poses.quaternion_B4, exp_quaternion(0.5 * math.radians(_VIEW_TURN_DEG) * turn))
        return PoseBatch(poses.position_B3 + _VIEW_SHIFT_M * shift, turned, poses.scene_B)

    def _matching_loss(self, real: list[Tensor], pose: Tensor, image_B3HW: Tensor) -> Tensor:
        """1 - cosine of each channel of the image's features and those of the view at the estimated pose.

        Its gradient reaches the pose through the view; the features stay what they are.
        """
        scene = torch.zeros(len(pose), dtype=torch.long, device=pose.device)
        at = self.frames.to_map(pose[:, :3], exp_quaternion(pose[:, 3:]), scene)
        view = self.renderer(at.position_B3, at.quaternion_B4, *image_B3HW.shape[-2:])
        with self._statistics_kept(), self._weights_kept():
            rendered, _ = self._features_and_pose(view)
        pairs = zip(real, rendered, strict=True)
        return torch.stack([1 - _cosine(a.detach(), b) for a, b in pairs]).mean()

    @contextmanager
    def _statistics_kept(self) -> Iterator[None]:
        """Batch norms normalise by the batch, but what testing normalises by is of images alone."""
        norms = [m for m in self.modules() if isinstance(m, nn.BatchNorm2d)]
        before = [norm.momentum for norm in norms]
        for norm in norms:
            norm.momentum = 0.0
        try:
            yield
        finally:
            for norm, momentum in zip(norms, before, strict=True):
                norm.momentum = momentum

    @contextmanager
    def _weights_kept(self) -> Iterator[None]:
        """No gradient to the weights."""
        weights = [p for p in self.parameters() if p.requires_grad]
        for weight in weights:
            weight.requires_grad_(False)
        try:
            yield
        finally:
            for weight in weights:
                weight.requires_grad_(True)


def triplet_loss(real: list[Tensor], rendered: list[Tensor], margin: float) -> Tensor:
    """max(0, d(real, rendered) - q + margin) over a batch's levels (B, C, H, W): d is the mean distance of the cells'
    features, q the smallest of those between one image or view and the next one's image or view."""
    losses = []
    for a, b in zip(real, rendered, strict=True):
        other_a, other_b = a.roll(1, 0), b.roll(1, 0)
        distances = [_distance(x, y) for x, y in ((a, other_b), (b, other_a), (a, other_a), (b, other_b))]
        hardest = torch.stack(distances).amin(0)
        losses.append((_distance(a, b) - hardest + margin).clamp_min(0).mean())
    return torch.stack(losses).mean()


def _distance(a_BCHW: Tensor, b_BCHW: Tensor) -> Tensor:
    return torch.linalg.vector_norm(a_BCHW - b_BCHW + 1e-6, dim=1).mean((1, 2))


def _cosine(a_BCHW: Tensor, b_BCHW: Tensor) -> Tensor:
    return nn.functional.cosine_similarity(a_BCHW.flatten(2), b_BCHW.flatten(2), dim=-1).mean()


def _adapter(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, _HIDDEN, 1), nn.ReLU(), nn.Conv2d(_HIDDEN, _MATCHED, 5, padding=2), nn.BatchNorm2d(_MATCHED)
    )


def make_dfnet(settings: DFNetSettings, scenes: int, outdoor: bool) -> DFNet:
    """DFNet with random weights."""
    return DFNet(settings)
