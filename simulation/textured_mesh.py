"""A place ready to be rendered: triangles, the picture of each, all pictures in an atlas; kept in a folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array

_ARRAYS = "mesh.npz"
_ATLAS = "atlas.npy"


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
    """Whether a whole mesh lies in the folder."""
    return (folder / _ARRAYS).is_file()
