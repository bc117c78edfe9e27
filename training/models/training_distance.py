"""How far an image and its answer are from the training images: errors grow with both.

Where no training image looks like this one, or none was taken near the answer, the network extrapolates, and says too
little of it by itself. The scales of a mixture's components, multiplied by both distances, rank errors at least as well
as the spread of the mixture does (rank correlations: docs/results/regressors.md).
"""

import torch
from torch import Tensor, nn

_IMAGES = 512  # kept of each scene at most
_FEATURES = 64  # compared, of the first principal components
_NEAREST = 4, 2  # of images by their features, and of poses
# What counts as much: this share of the walks' deviation in position, and this angle.
_POSITION, _RADIANS = 0.05, 0.3
_SMALLEST, _RANGE = 1e-6, (0.1, 100.0)
_UNUSED = 1e4  # of the features of rows without an image: no image is near


class TrainingDistance(nn.Module):
    """The product of two distances to the nearest training images of the scene: of features, and of poses in the
    frame of `SceneFrames`. Each is divided by its median over the training images themselves."""

    features_SNF: Tensor
    position_SN3: Tensor
    quaternion_SN4: Tensor
    median_S2: Tensor

    def __init__(self, scenes: int, width: int) -> None:
        super().__init__()
        self.register_buffer("features_SNF", torch.full((scenes, _IMAGES, min(width, _FEATURES)), _UNUSED))
        self.register_buffer("position_SN3", torch.full((scenes, _IMAGES, 3), _UNUSED))
        self.register_buffer("quaternion_SN4", torch.tensor([0.0, 0, 0, 1]).repeat(scenes, _IMAGES, 1))
        self.register_buffer("median_S2", torch.ones(scenes, 2))

    def fit(self, features_NF: Tensor, position_N3: Tensor, quaternion_N4: Tensor, scene_N: Tensor) -> None:
        """Keep training images, evenly out of all of a scene."""
        for scene in range(len(self.median_S2)):
            mine = torch.nonzero(scene_N == scene).squeeze(1)
            kept = mine[torch.linspace(0, len(mine) - 1, min(len(mine), _IMAGES)).round().long()]
            kept = kept[torch.arange(max(len(kept), 1 + _NEAREST[0])) % len(kept)]
            self.features_SNF[scene, : len(kept)] = features_NF[kept, : self.features_SNF.shape[-1]]
            self.position_SN3[scene, : len(kept)] = position_N3[kept]
            self.quaternion_SN4[scene, : len(kept)] = quaternion_N4[kept]
            scenes = torch.full_like(kept, scene)
            apart = self._distances(features_NF[kept], position_N3[kept], quaternion_N4[kept], scenes)
            for which, (distance, nearest) in enumerate(zip(apart, _NEAREST, strict=True)):
                others = distance.sort(dim=1).values[:, 1 : 1 + nearest]  # an image's nearest is itself
                self.median_S2[scene, which] = others.mean(dim=1).median()

    def forward(self, features_BF: Tensor, position_B3: Tensor, quaternion_B4: Tensor, scene_B: Tensor) -> Tensor:
        """(B,), about 1 at training images."""
        apart = self._distances(features_BF, position_B3, quaternion_B4, scene_B)
        near = [
            distance.topk(nearest, largest=False).values.mean(dim=1)
            for distance, nearest in zip(apart, _NEAREST, strict=True)
        ]
        medians = self.median_S2[scene_B].clamp_min(_SMALLEST)
        return (near[0] * near[1] / medians.prod(dim=1)).clamp(*_RANGE)

    def _distances(
        self, features_BF: Tensor, position_B3: Tensor, quaternion_B4: Tensor, scene_B: Tensor
    ) -> tuple[Tensor, Tensor]:
        """(B, N) each, of features and of poses."""
        kept_BNF = self.features_SNF[scene_B]
        features = torch.linalg.vector_norm(kept_BNF - features_BF[:, None, : kept_BNF.shape[-1]], dim=-1)
        apart = torch.linalg.vector_norm(self.position_SN3[scene_B] - position_B3[:, None], dim=-1)
        dot = (self.quaternion_SN4[scene_B] * quaternion_B4[:, None]).sum(-1).abs().clamp(max=1.0)
        return features, apart / _POSITION + 2 * torch.acos(dot) / _RADIANS
