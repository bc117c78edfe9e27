"""How far an image is from the training images: errors grow with that.

Where no training image looks like this one the network extrapolates, and says too little of it by itself. The scales of
a mixture's components, multiplied by the distance of features, rank the errors of a session that was held out of
training better than either does, than the spread of the mixture, and than the distance of the answer from the nearest
training poses (rank correlations: docs/results/regressors.md).
"""

import torch
from torch import Tensor, nn

_IMAGES = 512  # kept of each scene at most
_FEATURES = 32  # compared, of the first principal components
_NEAREST = 4
_SMALLEST, _RANGE = 1e-6, (0.1, 100.0)
_UNUSED = 1e4  # of the features of rows without an image: no image is near


class TrainingDistance(nn.Module):
    """The mean distance of features to the nearest training images of the scene, divided by its median over the
    training images themselves."""

    features_SNF: Tensor
    median_S: Tensor

    def __init__(self, scenes: int, width: int) -> None:
        super().__init__()
        self.register_buffer("features_SNF", torch.full((scenes, _IMAGES, min(width, _FEATURES)), _UNUSED))
        self.register_buffer("median_S", torch.ones(scenes))

    def fit(self, features_NF: Tensor, scene_N: Tensor) -> None:
        """Keep training images, evenly out of all of a scene."""
        for scene in range(len(self.median_S)):
            mine = torch.nonzero(scene_N == scene).squeeze(1)
            kept = mine[torch.linspace(0, len(mine) - 1, min(len(mine), _IMAGES)).round().long()]
            kept = kept[torch.arange(max(len(kept), 1 + _NEAREST)) % len(kept)]
            self.features_SNF[scene, : len(kept)] = features_NF[kept, : self.features_SNF.shape[-1]]
            distance = self._distances(features_NF[kept], torch.full_like(kept, scene))
            # An image's nearest is itself.
            self.median_S[scene] = distance.sort(dim=1).values[:, 1 : 1 + _NEAREST].mean(dim=1).median()

    def forward(self, features_BF: Tensor, scene_B: Tensor) -> Tensor:
        """(B,), about 1 at training images."""
        near = self._distances(features_BF, scene_B).topk(_NEAREST, largest=False).values.mean(dim=1)
        return (near / self.median_S[scene_B].clamp_min(_SMALLEST)).clamp(*_RANGE)

    def _distances(self, features_BF: Tensor, scene_B: Tensor) -> Tensor:
        """(B, N)."""
        kept_BNF = self.features_SNF[scene_B]
        return torch.linalg.vector_norm(kept_BNF - features_BF[:, None, : kept_BNF.shape[-1]], dim=-1)
