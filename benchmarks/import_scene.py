"""A walk in front of two textured walls, with what its camera sees: for checks that hold poses against images."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose
from tests.capture_import.capture_writers import Walk

RATE_HZ = 10.0
# What a data set without intrinsics assumes (7-Scenes), so that every format can hold the walk.
WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
_TEXTURE_PX, _M_PER_PX = 1200, 0.009
# Depth, and the x from and to which a wall reaches, in metres.
_WALLS = ((-4.0, -5.4, 0.6), (-2.6, 0.6, 5.4))


def rendered_walk(count: int, late_s: float = 0.0) -> Walk:
    """A walk of `count` poses, an image with each; images show what is seen `late_s` after their stated time."""
    s = np.arange(count) / RATE_HZ
    camera = np.tile([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], (count, 1))
    t_ns = np.round((5000.0 + s) * 1e9).astype(np.int64)
    texture = _texture()
    pictures = np.stack([_seen(texture, pose) for pose in _poses(s + late_s)])
    return Walk(t_ns, _poses(s), camera, np.ones(count, bool), pictures)


def _poses(s: Array) -> Array:
    """vio_T_cam (N, 4, 4) at seconds (N,): slowly along the walls and towards them, looking around."""
    positions = np.stack([0.25 * s - 0.7, 1.4 + 0.15 * np.sin(1.3 * s), 0.4 - 0.2 * s], axis=-1)
    angles = np.stack([0.25 * np.sin(2 * s), 0.12 * np.cos(1.7 * s), 0.05 * np.sin(s)], axis=-1)
    # Upright, looking along -z of the world: camera x right, y down, z forward.
    return make_pose(Rotation.from_euler("YXZ", angles).as_matrix() @ np.diag([1.0, -1.0, -1.0]), positions)


def _texture() -> np.ndarray:
    """Blobs and grain (H, W, 3), nowhere black."""
    rng = np.random.default_rng(3)
    blobs = cv2.resize(
        rng.integers(10, 255, (150, 150, 3), dtype=np.uint8), (_TEXTURE_PX, _TEXTURE_PX), interpolation=cv2.INTER_CUBIC
    )
    grain = rng.integers(10, 255, blobs.shape, dtype=np.uint8)
    return np.maximum(np.round(0.6 * blobs + 0.4 * grain), 1).astype(np.uint8)


def _seen(texture: np.ndarray, world_T_cam: Array) -> np.ndarray:
    """The walls as a camera sees them (H, W, 3); a nearer wall hides a farther one."""
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cam_R_world, centre = world_T_cam[:3, :3].T, world_T_cam[:3, 3]
    left, top = -_TEXTURE_PX * _M_PER_PX / 2, 1.4 + _TEXTURE_PX * _M_PER_PX / 2
    columns = (np.arange(_TEXTURE_PX) + 0.5) * _M_PER_PX + left
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for depth, start, stop in _WALLS:
        strip = np.where(((columns >= start) & (columns < stop))[:, None], texture, 0).astype(np.uint8)
        # Texture pixels to the wall's x and y, to the world seen from the camera's place, to the image.
        plane = np.array([[_M_PER_PX, 0, left], [0, -_M_PER_PX, top], [0, 0, 1]])
        world = np.array([[1, 0, 0], [0, 1, 0], [0, 0, depth]]) - np.outer(centre, [0, 0, 1])
        # OpenCV counts from the centre of the first pixel, our intrinsics from its corner.
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        seen = cv2.warpPerspective(
            strip, np.linalg.inv(half) @ k @ cam_R_world @ world @ plane @ half, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR
        )
        picture = np.where(seen.any(axis=-1, keepdims=True), seen, picture)
    return picture
