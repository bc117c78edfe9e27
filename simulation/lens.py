"""A phone's lens as OpenCV describes it (k1, k2, k3), and its inverse: from image points to the rays that they see."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation.place import Vec

F32 = NDArray[np.float32]
_NODES = 1 << 16
_MIN_SLOPE = 0.2
_NEWTON_STEPS = 30


@dataclass(frozen=True)
class Lens:
    """Radial distortion in OpenCV's convention: a ray (x, y, 1) of r² = x² + y² is seen at
    (x, y) (1 + k1 r² + k2 r⁴ + k3 r⁶).

    That polynomial may fold back at some radius, which a real lens doesn't do. From where its slope has fallen to 0.2,
    the image radius goes on with this slope, and the coefficients no longer describe the picture there.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0

    @property
    def is_pinhole(self) -> bool:
        """Whether it leaves all rays where they are."""
        return self.k1 == self.k2 == self.k3 == 0

    @property
    def last_radius(self) -> float:
        """The largest radius r of rays (x, y, 1) that the polynomial describes; inf where it never folds."""
        # 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ = _MIN_SLOPE, s = r²
        roots = np.roots([7 * self.k3, 5 * self.k2, 3 * self.k1, 1 - _MIN_SLOPE])
        ahead = [float(s.real) for s in roots if abs(s.imag) < 1e-12 and s.real > 0]
        return math.sqrt(min(ahead)) if ahead else math.inf

    def slope(self, radius: Vec) -> Vec:
        """Derivative of the polynomial's image radius by `radius` (N,)."""
        s = radius * radius
        return 1 + s * (3 * self.k1 + s * (5 * self.k2 + 7 * s * self.k3))

    def image_radius(self, radius: Vec) -> Vec:
        """How far from the principal point rays of `radius` (N,) are seen, in focal lengths."""
        last = self.last_radius
        inner = np.minimum(radius, last)
        s = inner * inner
        beyond = np.where(radius > last, radius - inner, 0.0) * _MIN_SLOPE
        return inner * (1 + s * (self.k1 + s * (self.k2 + s * self.k3))) + beyond

    def distort(self, xy_N2: Vec) -> Vec:
        """Where rays (x, y, 1) are seen: image points (N, 2) about the principal point, in focal lengths."""
        radius = np.linalg.norm(xy_N2, axis=-1, keepdims=True)
        return xy_N2 * np.where(radius > 0, self.image_radius(radius) / np.maximum(radius, 1e-300), 1.0)

    def undistort(self, x: F32, y: F32) -> tuple[F32, F32, tuple[F32, F32, F32]]:
        """Rays (x, y, 1) that image points see, and the derivative of the ray by the image point: xx, xy, yy (N,)."""
        square = x * x + y * y
        reach = 2.0 ** math.ceil(math.log2(max(float(square.max(initial=0.0)), 1.0)))
        ratio = _ratios(self, reach)
        place = square * np.float32(_NODES / reach)
        node = place.astype(np.int32)
        low = ratio[node]
        rise = ratio[node + 1] - low
        factor = low + (place - node.astype(np.float32)) * rise
        bend = rise * np.float32(2 * _NODES / reach)
        bend_x = bend * x
        return factor * x, factor * y, (factor + bend_x * x, bend_x * y, factor + bend * y * y)


PINHOLE = Lens()


@functools.lru_cache(maxsize=16)
def _ratios(lens: Lens, reach: float) -> F32:
    """Radius of the ray by radius in the image (_NODES + 2,), at squared image radii from 0 to `reach` and one more."""
    image = np.sqrt(np.arange(_NODES + 2) * (reach / _NODES))
    last = lens.last_radius
    last_image = float(lens.image_radius(np.array(last))) if math.isfinite(last) else math.inf
    inside = np.minimum(image, last_image)
    # Bisection brackets the only root up to `last`; Newton alone could leave for another branch.
    low, high = np.zeros_like(inside), np.full_like(inside, min(last, 10.0))
    radius = inside.copy()
    for _ in range(_NEWTON_STEPS):
        error = lens.image_radius(radius) - inside
        low, high = np.where(error < 0, radius, low), np.where(error > 0, radius, high)
        step = radius - error / np.maximum(lens.slope(radius), _MIN_SLOPE / 2)
        radius = np.where((step > low) & (step < high), step, (low + high) / 2)
    if math.isfinite(last):
        radius += (image - inside) / _MIN_SLOPE
    ratio = np.ones_like(image)
    ratio[1:] = radius[1:] / image[1:]
    return ratio.astype(np.float32)
