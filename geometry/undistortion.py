"""Images without the distortion of their lens: as a pinhole at the same place, looking the same way, sees them.

Positions are in pixels with the centre of the first one at (0.5, 0.5); OpenCV has it at (0, 0).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry import GeometryError
from geometry.lens import distort, undistort
from geometry.poses import Array

_GRID = 33
_RELATIVE, _ROUNDING_PX = 1e-6, 1e-6


@dataclass(frozen=True)
class Camera:
    """Image size, focal lengths and principal point in pixels; OpenCV's k1, k2, p1, p2, k3, ..., empty for a pinhole"""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def is_pinhole(self) -> bool:
        """No coefficient of distortion differs from 0."""
        return not any(self.distortion)

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
        """Ideal image points (M, 2) of pixels (M, 2), the inverse of `project`."""
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
        grid = np.stack(np.meshgrid(camera.width * side, camera.height * side), axis=-1) / focal_px
        px = camera.project(grid.reshape(-1, 2)).reshape(grid.shape)
        right, down = px[:-1, 1:] - px[:-1, :-1], px[1:, :-1] - px[:-1, :-1]
        one_to_one = right[..., 0] * down[..., 1] > right[..., 1] * down[..., 0]
        size = np.array([camera.width, camera.height])
        return bool(one_to_one.all() and (px >= -_ROUNDING_PX).all() and (px <= size + _ROUNDING_PX).all())

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


def undistorted_image(image: NDArray[np.uint8], camera: Camera, pinhole: Camera) -> NDArray[np.uint8]:
    """What `pinhole` sees (its height, its width, channels) where `camera` took `image`, by bicubic interpolation.

    Beyond the image its border is repeated. GeometryError where the image hasn't the camera's size.
    """
    if image.shape[:2] != (camera.height, camera.width):
        raise GeometryError(
            f"the image is {image.shape[1]} x {image.shape[0]} px, its camera {camera.width} x {camera.height} px"
        )
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    eight = np.pad(np.array(camera.distortion, float), (0, 8 - len(camera.distortion)))
    size = (pinhole.width, pinhole.height)
    at = cv2.initUndistortRectifyMap(camera.matrix - half, eight, np.eye(3), pinhole.matrix - half, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)
