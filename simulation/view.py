"""A phone's camera: its lens as OpenCV describes it and the inverse, its rolling shutter, its pose."""

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array, inverse, quaternion_from_matrix

F32 = NDArray[np.float32]
_NODES = 1 << 16
_MIN_SLOPE = 0.2
_NEWTON_STEPS = 30
_ROWS = (-0.5, -0.25, 0.25, 0.5)  # of the height, from the middle row


@dataclass(frozen=True)
class RadialDistortion:
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

    def slope(self, radius: Array) -> Array:
        """Derivative of the polynomial's image radius by `radius` (N,)."""
        s = radius * radius
        return 1 + s * (3 * self.k1 + s * (5 * self.k2 + 7 * s * self.k3))

    def image_radius(self, radius: Array) -> Array:
        """How far from the principal point rays of `radius` (N,) are seen, in focal lengths."""
        last = self.last_radius
        inner = np.minimum(radius, last)
        s = inner * inner
        beyond = np.where(radius > last, radius - inner, 0.0) * _MIN_SLOPE
        return inner * (1 + s * (self.k1 + s * (self.k2 + s * self.k3))) + beyond

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


PINHOLE = RadialDistortion()


@functools.lru_cache(maxsize=16)
def _ratios(lens: RadialDistortion, reach: float) -> F32:
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


@dataclass(frozen=True)
class Shutter:
    """The camera's motion over the rows, in the axes of its pose at the middle row, as polynomials without constant in
    a row's height u = y / height - 0.5: `turn_33` (axis times the tangent of half the angle), `shift_33` (metres)."""

    turn_33: Array
    shift_33: Array

    def motion(self, u: F32) -> tuple[list[F32], list[F32]]:
        """Turn and shift at rows u (N,): three arrays (N,) each."""
        return [_polynomial(c, u) for c in self.turn_33.T], [_polynomial(c, u) for c in self.shift_33.T]


def row_times(readout_s: float) -> Array:
    """When the rows are exposed whose poses `shutter` asks for, seconds from the middle row."""
    return readout_s * np.array(_ROWS)


def shutter(world_T_middle: Array, world_T_row: Array) -> Shutter:
    """The shutter of a camera whose poses are `world_T_middle` (4, 4) at the middle row and `world_T_row` (4, 4, 4) at
    `row_times`."""
    middle_T_row = inverse(world_T_middle) @ world_T_row
    quaternion = quaternion_from_matrix(middle_T_row[:, :3, :3])
    powers = np.stack([np.array(_ROWS) ** k for k in (1, 2, 3)], axis=1)
    turn = np.linalg.lstsq(powers, quaternion[:, :3] / quaternion[:, 3:])[0]
    return Shutter(turn, np.linalg.lstsq(powers, middle_T_row[:, :3, 3])[0])


def turned(turn: list[F32], x: F32, y: F32) -> tuple[F32, F32, F32]:
    """Vectors (x, y, 1), each turned by its own rotation (axis times the tangent of half the angle)."""
    a, b, c = turn
    # v + 2 / (1 + |g|²) (g x v + g x (g x v))
    p, q, r = b - c * y, c * x - a, a * y - b * x
    scale = np.float32(2) / (1 + a * a + b * b + c * c)
    return (x + scale * (p + b * r - c * q), y + scale * (q + c * p - a * r), 1 + scale * (r + a * q - b * p))


def _polynomial(coefficients_3: Array, u: F32) -> F32:
    first, second, third = (np.float32(c) for c in coefficients_3)
    return np.asarray(u * (first + u * (second + u * third)), np.float32)


@dataclass(frozen=True)
class View:
    """A camera: OpenCV axes, pixel centres at 0.5, focal length and principal point in pixels, the pose at the middle
    row; no shutter: all rows at once."""

    world_T_cam: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    lens: RadialDistortion = PINHOLE
    shutter: Shutter | None = None

    def points(self, x: F32, y: F32) -> tuple[F32, F32]:
        """Pixels about the principal point, in focal lengths."""
        return (x - np.float32(self.cx)) / np.float32(self.fx), (y - np.float32(self.cy)) / np.float32(self.fy)


@dataclass(frozen=True)
class Rendering:
    """A sharp, noiseless picture (H, W, 3) in display values 0 to 255, and depth along z (H, W), inf for sky."""

    image: F32
    depth: F32
