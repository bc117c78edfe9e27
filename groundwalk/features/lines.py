"""Straight lines in images."""

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array

# Shorter lines, in focal lengths, have no sure direction, and fewer say nothing.
_MIN_LENGTH = 0.06
MIN_LINES = 100
LONG_SIDE = 480  # of the images that lines are looked for in


def planes_of_lines(gray: NDArray[np.uint8], camera: Camera, world_R_cam: Array) -> tuple[Array, Array]:
    """Of the straight lines that an image (H, W) shows, which may be smaller than its camera's: unit normals (N, 3), in
    the world, of their planes through the camera's centre, and lengths (N,) in focal lengths."""
    segments = cv2.createLineSegmentDetector().detect(gray)[0]
    ends = np.zeros((0, 2)) if segments is None else segments.reshape(-1, 2).astype(float) + 0.5
    ideal = camera.unproject(ends * camera.width / gray.shape[1])
    rays = np.column_stack([ideal, np.ones(len(ideal))]).reshape(-1, 2, 3)
    length = np.linalg.norm(rays[:, 1] - rays[:, 0], axis=1)
    rays, length = rays[length > _MIN_LENGTH], length[length > _MIN_LENGTH]
    normals = np.cross(rays[:, 0], rays[:, 1])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True) @ world_R_cam.T, length
