"""Ray casting through open3d, whose shared library needs libusb even though nothing here touches USB."""

import ctypes
import functools
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.store import UserError

NOTHING = -1


@functools.cache
def _open3d() -> Any:
    """The open3d module; UserError where it, or the libusb that it links, can't be loaded."""
    try:
        if sys.platform == "linux":
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        import open3d
    except (ImportError, OSError) as error:
        raise UserError("open3d can't be loaded", found=error, do="pip install -c constraints.txt -e .") from None
    return open3d


class Caster:
    """Triangles (T, 3) over vertices (V, 3), ready to cast rays at. One thread a call: processes share the cores."""

    def __init__(self, vertices_V3: NDArray[np.float64], triangles_T3: NDArray[np.int64]) -> None:
        o3d = _open3d()
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices_V3, np.float32)),
            self._tensor(np.ascontiguousarray(triangles_T3, np.uint32)),
        )

    def cast(self, rays_N6: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The first triangle that each ray (origin, direction) meets (NOTHING), and how far off, in units of its
        direction (inf for nothing)."""
        answer = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays_N6, np.float32)), nthreads=1)
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        distance = answer["t_hit"].numpy()
        triangle[~np.isfinite(distance)] = NOTHING
        return triangle, distance

    def blocked(self, rays_N6: NDArray[np.float32], reach: float) -> NDArray[np.bool_]:
        """Whether each ray meets anything before `reach` times its direction."""
        rays = self._tensor(np.ascontiguousarray(rays_N6, np.float32))
        met: NDArray[np.bool_] = self._scene.test_occlusions(rays, tnear=0.0, tfar=reach, nthreads=1).numpy()
        return met
