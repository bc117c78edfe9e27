"""Views of the map: its coloured points, drawn as splats, differentiable in the pose.

A point is shared among the four nearest pixels, near points outweigh those behind them, and pixels that no point falls
on take the colours around them, from coarser and coarser images (Grossman and Dally, "Point sample rendering", 1998).
"""

import numpy as np
import torch
from torch import Tensor, nn

from groundwalk.training.data import normalised
from groundwalk.training.models.regressor import MapPoints
from groundwalk.training.poses import as_matrix

_NEAR_M = 0.3
_NEARNESS = 4  # power of 1 / depth that a point counts by
_HALF = 0.1  # of a point, on a pixel, that counts as much as the colours around
_TINY = 1e-12


class PointRenderer(nn.Module):
    """Images at given poses, from `points` of the map's points: every so manyth, or some several times where it has
    fewer. Held as buffers, so that a stopped training has them."""

    position_P3: Tensor
    colour_P3: Tensor
    focal_px: Tensor

    def __init__(self, points: int) -> None:
        super().__init__()
        self.register_buffer("position_P3", torch.zeros(points, 3))
        self.register_buffer("colour_P3", torch.zeros(points, 3))
        self.register_buffer("focal_px", torch.ones(()))

    def fit(self, points: MapPoints) -> None:
        """Take the map's points."""
        rows = np.linspace(0, len(points.position_P3) - 1, len(self.position_P3)).astype(np.int64)
        self.position_P3.copy_(points.position_P3[rows])
        self.colour_P3.copy_(points.colour_P3[rows])
        self.focal_px.fill_(points.focal_px)

    def forward(self, position_B3: Tensor, quaternion_B4: Tensor, height: int, width: int) -> Tensor:
        """Normalised images (B, 3, height, width) of the pinhole at poses map_T_cam, its principal point in the
        middle."""
        with torch.autocast(position_B3.device.type, enabled=False):
            sums = self._splatted(position_B3.float(), quaternion_B4.float(), height, width)
            return normalised(_filled(sums))

    def _splatted(self, position_B3: Tensor, quaternion_B4: Tensor, height: int, width: int) -> Tensor:
        """Sums (B, 5, height, width) over the points: colours by nearness, nearness, and plain shares."""
        cam = (self.position_P3 - position_B3[:, None]) @ as_matrix(quaternion_B4)
        depth = cam[..., 2].clamp_min(_NEAR_M)
        middle = torch.tensor([width, height], device=cam.device) / 2
        pixel = cam[..., :2] / depth[..., None] * self.focal_px + middle - 0.5
        inside = (cam[..., 2] > _NEAR_M) & (pixel > -1).all(-1) & (pixel < 2 * middle).all(-1)
        sample, point = inside.nonzero(as_tuple=True)
        pixel, near = pixel[sample, point], depth[sample, point] ** -_NEARNESS
        first = pixel.detach().floor()
        # One pixel more on each side takes what falls half outside.
        sums = torch.zeros(5, len(position_B3) * (height + 2) * (width + 2), device=cam.device)
        for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
            at = first + torch.tensor(corner, device=cam.device)
            share = (1 - (pixel - at).abs()).prod(-1)
            across, down = (at.long() + 1).unbind(-1)
            weight = share * near
            values = torch.cat([self.colour_P3[point].T * weight, weight[None], share[None]])
            sums = sums.index_add(1, (sample * (height + 2) + down) * (width + 2) + across, values)
        return sums.view(5, -1, height + 2, width + 2).transpose(0, 1)[:, :, 1:-1, 1:-1]


def _filled(sums: Tensor) -> Tensor:
    """Colours (B, 3, H, W), 0 to 1, of such sums."""
    levels = [sums]
    while max(levels[-1].shape[-2:]) > 1:
        levels.append(nn.functional.avg_pool2d(levels[-1], 2, ceil_mode=True, divisor_override=1))
    colour = torch.zeros_like(levels[-1][:, :3])
    for level in reversed(levels):
        around = nn.functional.interpolate(colour, level.shape[-2:], mode="bilinear", align_corners=False)
        covered = level[:, 4:] / (level[:, 4:] + _HALF)
        colour = covered * level[:, :3] / level[:, 3:4].clamp_min(_TINY) + (1 - covered) * around
    return colour
