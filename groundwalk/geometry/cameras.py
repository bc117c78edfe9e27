"""A camera with a lens, and pinholes at its place that look the same way.

Positions are in pixels with the centre of the first one at (0.5, 0.5).
"""

from dataclasses import dataclass, replace

import numpy as np

from groundwalk.geometry import Array, GeometryError
from groundwalk.geometry.lens import distort, distort_with_slope, undistort

CENTRE_OF_FIRST_PIXEL = 0.5
"""Where OpenCV, and formats that follow it, have (0, 0)."""
_GRID = 33
_RELATIVE, _ROUNDING_PX = 1e-6, 1e-6


@dataclass(frozen=True)
class Camera:
    """Image size, focal lengths and principal point in pixels; OpenCV's k1, k2, p1, p2, k3, ..., empty for a pinhole;
    the side of the image that the sensor reads out first, None for that of phones (`usual_first_row`)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    first_row: str | None = None

    @property
    def matrix(self) -> Array:
        """K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the image resized to another size."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y)

    def project(self, ideal_M2: Array) -> Array:
        """Pixels (M, 2) of ideal image points (M, 2), which are at unit focal length about the principal point."""
        return distort(ideal_M2, self.distortion) * [self.fx, self.fy] + [self.cx, self.cy]

    def unproject(self, px_M2: Array) -> Array:
        """Ideal image points (M, 2) of pixels (M, 2), the inverse of `project`; NaN where the lens has none."""
        return undistort((np.asarray(px_M2, float) - [self.cx, self.cy]) / [self.fx, self.fy], self.distortion)


def centred_pinhole(width: int, height: int, focal_px: float) -> Camera:
    """A pinhole with square pixels and its principal point in the middle of the image."""
    return Camera(width, height, focal_px, focal_px, width / 2, height / 2)


def pinhole_within(camera: Camera) -> Camera:
    """The centred pinhole of the same image size that sees nothing but what `camera` sees: no border stays empty.

    Its focal length is the smallest, to 1e-6, for which all of its image lies in the camera's and the distortion is one
    to one over it. GeometryError where no focal length of a tenth to ten times the camera's is that long.
    """

    def fits(focal_px: float) -> bool:
        side = np.linspace(-0.5, 0.5, _GRID)
        x, y = np.meshgrid(camera.width * side / focal_px, camera.height * side / focal_px)
        distorted, slope = distort_with_slope(np.stack([x.ravel(), y.ravel()], axis=1), camera.distortion)
        px = distorted * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        inside = (px >= -_ROUNDING_PX) & (px <= np.array([camera.width, camera.height]) + _ROUNDING_PX)
        return bool(inside.all() and (np.linalg.det(slope) > 0).all())

    too_short, fitting = 0.1 * min(camera.fx, camera.fy), 10 * max(camera.fx, camera.fy)
    if not fits(fitting):
        raise GeometryError(
            f"no pinhole sees a part of this camera's image alone: {camera.width} x {camera.height} px, focal length "
            f"{camera.fx:.1f} px, principal point ({camera.cx:.1f}, {camera.cy:.1f}), distortion "
            f"{list(camera.distortion)}"
        )
    while fitting - too_short > _RELATIVE * fitting:
        middle = (too_short + fitting) / 2
        too_short, fitting = (too_short, middle) if fits(middle) else (middle, fitting)
    return centred_pinhole(camera.width, camera.height, fitting)
