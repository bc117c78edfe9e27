"""Images as networks see them: small, all of one pinhole, and turned."""

import cv2
import numpy as np

from groundwalk.geometry import Array
from groundwalk.geometry.cameras import Camera, centred_pinhole
from groundwalk.store.images import Image
from groundwalk.store.undistortion import undistorted_image


def small_image(image: Image, short_side: int) -> Image:
    """The image with `short_side` pixels on its shorter side, as captured otherwise."""
    return _resized(image, *_small_size(image, short_side))


def pinhole_image(image: Image, camera: Camera, short_side: int, focal: float) -> Image:
    """What the virtual pinhole, whose focal length is `focal` shorter sides, sees where `camera` took the image.

    As large as `small_image` makes it; its principal point is in the middle. Beyond the image its border is repeated.
    """
    pinhole = centred_pinhole(*_small_size(image, short_side), focal * short_side)
    # Half-sized pixels keep sharp what a second interpolation would blur.
    finer = min(2.0, max(1.0, min(image.shape[:2]) / short_side))
    size = round(finer * pinhole.width), round(finer * pinhole.height)
    seen = undistorted_image(_resized(image, *size), camera.resized(*size), pinhole.resized(*size))
    return _resized(seen, pinhole.width, pinhole.height)


def turned_crop(image: Image, K: Array, cam_R_turned: Array, width: int, height: int) -> Image:
    """What a camera turned by `cam_R_turned` (3, 3) sees through a window in the image's middle.

    `K` (3, 3) are the image's intrinsics, pixel centres at 0.5; beyond the image its border is repeated.
    """
    left, top = (image.shape[1] - width) // 2, (image.shape[0] - height) // 2
    to_window = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]])
    window_from_image = to_window @ K @ cam_R_turned.T @ np.linalg.inv(K)
    # OpenCV counts from pixel centres, the intrinsics from the corner.
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    homography = np.linalg.inv(half) @ window_from_image @ half
    turned = cv2.warpPerspective(image, homography, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(turned, np.uint8)


def _small_size(image: Image, short_side: int) -> tuple[int, int]:
    """Width and height."""
    height, width = image.shape[:2]
    scale = short_side / min(height, width)
    return max(short_side, round(width * scale)), max(short_side, round(height * scale))


def _resized(image: Image, width: int, height: int) -> Image:
    shrinks = width < image.shape[1]
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(small, np.uint8)
