"""All pictures of a place in one image with its mip levels, so that one remap looks up any surface at any scale."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of

LEVELS = 6
_GUTTER = 1 << (LEVELS - 1)  # one texel of the coarsest level: neighbours never bleed into a picture
_WIDTHS = (4096, 8192, 16384)
_MAX_SIDE = 32766  # what cv2.remap can address
_ARRAYS = "mesh.npz"
_ATLAS = "atlas.npy"


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


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles of a place and how each looks up its colour.

    texel = texel_a_T23 @ point + texel_b_T2 maps a world point on triangle t to its picture (x right, y down, texel
    centres at 0.5); `box_T4` is that picture's place in the atlas (x, y, width, height). `tint_T` multiplies
    colours, `surface_T` tells surfaces apart, `glass_T` marks panes.
    """

    vertices_V3: Array
    triangles_T3: NDArray[np.int64]
    texel_a_T23: Array
    texel_b_T2: Array
    box_T4: NDArray[np.float32]
    tint_T: NDArray[np.float32]
    surface_T: NDArray[np.int32]
    glass_T: NDArray[np.bool_]
    atlas_shape: NDArray[np.int64]
    atlas_HW3: NDArray[np.uint8]

    @property
    def normals_T3(self) -> Array:
        """Unit normals, outward."""
        a, b, c = (self.vertices_V3[self.triangles_T3[:, k]] for k in range(3))
        n = np.cross(b - a, c - a)
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    def save(self, folder: Path) -> None:
        """Write the mesh so that several processes can map it; complete once _ARRAYS is there."""
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / _ATLAS, self.atlas_HW3)
        arrays = {k: v for k, v in vars(self).items() if k != "atlas_HW3"}
        partial = folder / "partial.npz"
        np.savez(partial, **arrays)
        partial.replace(folder / _ARRAYS)

    @staticmethod
    def load(folder: Path) -> "TexturedMesh":
        """A saved mesh; the atlas stays on disk, mapped into memory."""
        with np.load(folder / _ARRAYS) as arrays:
            return TexturedMesh(**arrays, atlas_HW3=np.load(folder / _ATLAS, mmap_mode="r"))


def is_saved(folder: Path) -> bool:
    return (folder / _ARRAYS).is_file()
