"""All pictures of a place in one image with its mip levels, so that one remap looks up any surface at any scale."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.store import UserError
from groundwalk.store.hints import setting_of

LEVELS = 6
_GUTTER = 1 << (LEVELS - 1)  # one texel of the coarsest level: neighbours never bleed into a picture
_WIDTHS = (4096, 8192, 16384)
_MAX_SIDE = 32766  # what cv2.remap can address


def pack(sizes_N2: Sequence[tuple[int, int]]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Places pictures of (height, width) texels on shelves; returns origins (N, 2) as (x, y) and (height, width).

    Origins and cells are multiples of the coarsest level's texel. UserError where it all doesn't fit.
    """
    cells = [tuple(-(-(side + 2 * _GUTTER) // _GUTTER) * _GUTTER for side in size) for size in sizes_N2]
    area = sum(h * w for h, w in cells)
    width = next((w for w in _WIDTHS if area < 0.85 * w * w * 1.5), _WIDTHS[-1])
    width = max(width, max(w for _, w in cells))
    origins = np.zeros((len(cells), 2), np.int64)
    x = y = shelf = 0
    for i in sorted(range(len(cells)), key=lambda k: (-cells[k][0], k)):
        h, w = cells[i]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        origins[i] = x + _GUTTER, y + _GUTTER
        x, shelf = x + w, max(shelf, h)
    height = y + shelf
    if height > _MAX_SIDE or width * 3 // 2 > _MAX_SIDE:
        raise UserError(
            "the pictures of this place don't fit into one image",
            expected=f"at most {_MAX_SIDE} texels a side",
            found=f"{width * 3 // 2} x {height}",
            do=f"raise {setting_of('simulate', 'texel_m')}",
        )
    return origins, (height, width)


def level_offsets(height: int, width: int) -> NDArray[np.float32]:
    """Where each level's (0, 0) lies, (LEVELS, 2) as (x, y): level 0 on the left, the others stacked right of it."""
    offsets = [(0, 0)]
    y = 0
    for level in range(1, LEVELS):
        offsets.append((width, y))
        y += height >> level
    return np.array(offsets, np.float32)


def put(atlas: NDArray[np.uint8], origin: NDArray[np.int64], picture: NDArray[np.uint8]) -> None:
    """Copy a picture into level 0, its border drawn out over the gutter."""
    h, w = picture.shape[:2]
    cell_h, cell_w = (-(-(side + 2 * _GUTTER) // _GUTTER) * _GUTTER for side in (h, w))
    framed = cv2.copyMakeBorder(
        picture, _GUTTER, cell_h - h - _GUTTER, _GUTTER, cell_w - w - _GUTTER, cv2.BORDER_REPLICATE
    )
    x, y = origin - _GUTTER
    atlas[y : y + cell_h, x : x + cell_w] = framed


def fill_levels(atlas: NDArray[np.uint8], height: int, width: int) -> None:
    """Make levels 1 and up by halving, each texel the mean of four."""
    finer = np.ascontiguousarray(atlas[:height, :width])
    for level, (x, y) in enumerate(level_offsets(height, width).astype(int)):
        if level:
            half = cv2.resize(finer, (width >> level, height >> level), interpolation=cv2.INTER_AREA)
            finer = np.asarray(half, np.uint8)
            atlas[y : y + finer.shape[0], x : x + finer.shape[1]] = finer
