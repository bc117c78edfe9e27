"""Images without the distortion of their lens: as a pinhole at the same place, looking the same way, sees them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera


def undistorted_image(image: NDArray[np.uint8], camera: Camera, pinhole: Camera) -> NDArray[np.uint8]:
    """What `pinhole` sees (its height, its width, channels) where `camera` took `image`, by bicubic interpolation.

    Beyond the image its border is repeated. GeometryError where the image hasn't the camera's size.
    """
    if image.shape[:2] != (camera.height, camera.width):
        raise GeometryError(
            f"the image is {image.shape[1]} x {image.shape[0]} px, its camera {camera.width} x {camera.height} px"
        )
    # OpenCV has the centre of the first pixel at (0, 0).
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    eight = np.pad(np.array(camera.distortion, float), (0, 8 - len(camera.distortion)))
    size = (pinhole.width, pinhole.height)
    at = cv2.initUndistortRectifyMap(camera.matrix - half, eight, np.eye(3), pinhole.matrix - half, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, *at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)
