"""A made-up place for tests: points with descriptors on the walls of a room, and cameras that walk along them."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from groundwalk.features.sift import Features
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array, inverse, make_pose, transform
from groundwalk.localisation.frames import Views
from groundwalk.localisation.prepared import Training

LENS = (0.09, -0.12, 0.0, 0.0)
# The phone's principal point is off by 4 px along the sensor's rows and 3 px against its columns.
LOGGED = Camera(640, 480, 480.0, 480.0, 317.0, 242.0)
LOGGED_HIGH = Camera(480, 640, 480.0, 480.0, 236.0, 317.0, (), "right")
SEEN_BY = Camera(640, 480, 480.0, 480.0, 321.0, 239.0, LENS, "top")
HIGH = Camera(480, 640, 480.0, 480.0, 239.0, 321.0, LENS, "right")
READOUT_S = 0.02
DOWN = np.array([0, -1.0, 0])


@dataclass(frozen=True)
class Place:
    """Points (P, 3) with RootSIFT-like descriptors (P, 128)."""

    xyz: Array
    descriptors: np.ndarray


def place(seed: int = 0, points: int = 1500) -> Place:
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-6, -1.5, 4], [6, 2.5, 6], (points, 3))
    return Place(xyz, _descriptors(rng, points))


def walk(
    count: int,
    seed: int = 1,
    *,
    moving: bool = True,
    focal_sd: float = 0.0,
    reach_m: float = 4,
    camera: Camera = SEEN_BY,
) -> Views:
    """Cameras (count) that look at the wall from different places, upright but for some degrees."""
    rng = np.random.default_rng(seed)
    turn = np.radians([8, 15, 5]) * rng.standard_normal((count, 3))
    upright = np.diag([-1.0, -1.0, 1.0])  # y down, looking along +z
    rotation = Rotation.from_rotvec(turn).as_matrix() @ upright
    position = np.stack([np.linspace(-reach_m, reach_m, count), *(0.3 * rng.standard_normal((2, count)))], axis=1)
    cameras = tuple(
        replace(camera, fx=camera.fx * f, fy=camera.fy * f) for f in np.exp(focal_sd * rng.standard_normal(count))
    )
    angular, velocity = ((sd if moving else 0) * rng.standard_normal((count, 3)) for sd in (0.2, 0.5))
    return Views(make_pose(rotation, position), cameras, np.full(count, READOUT_S), angular, velocity)


def projected(views: Views, view: int, xyz: Array) -> Array:
    """Where a rolling shutter sees points (P, 3), (P, 2), NaN outside the image: iterated to the row's time."""
    camera = views.cameras[view]
    still = transform(inverse(views.map_T_cam[view]), xyz)
    with np.errstate(divide="ignore", invalid="ignore"):
        px = np.where(still[:, 2:] > 0.1, camera.project(still[:, :2] / still[:, 2:]), np.nan)
        for _ in range(5):
            x, y = px[:, :1] / camera.width, px[:, 1:] / camera.height
            row = {"top": y, "right": 1 - x, "bottom": 1 - y, "left": x}[camera.first_row or ""]
            time_s = (row - 0.5) * READOUT_S
            cam = still - time_s * (views.velocity[view] + np.cross(views.angular[view], still))
            px = np.where(cam[:, 2:] > 0.1, camera.project(cam[:, :2] / cam[:, 2:]), np.nan)
    # Far outside the image the lens' polynomial turns back into it.
    within = (px >= 0) & (px <= [camera.width, camera.height]) & (np.abs(still[:, :2]) < still[:, 2:])
    return np.where(np.all(within, axis=1, keepdims=True), px, np.nan)


def features(scene: Place, views: Views, view: int, seed: int = 3, noise_px: float = 0.3) -> Features:
    """What a frame sees of a place: noisy keypoints and descriptors, and some that belong to no point."""
    rng = np.random.default_rng([seed, view])
    px = projected(views, view, scene.xyz)
    seen = rng.permutation(np.flatnonzero(np.isfinite(px).all(axis=1)))
    clutter = len(seen) // 3
    noise = noise_px * rng.standard_normal((len(seen), 2))
    size = views.cameras[view].width, views.cameras[view].height
    at = np.concatenate([px[seen] + noise, rng.uniform([0, 0], size, (clutter, 2))])
    descriptors = scene.descriptors[seen].astype(float) + rng.normal(0, 5, (len(seen), 128))
    both = np.concatenate([np.clip(np.rint(descriptors), 0, 255).astype(np.uint8), _descriptors(rng, clutter)])
    order = rng.permutation(len(at))
    return Features(at[order].astype(np.float32), np.full(len(at), 4, np.float32), both[order])


def training(scene: Place, views: Views) -> Training:
    gravity = views.map_T_cam[:, :3, :3].transpose(0, 2, 1) @ DOWN
    seen = tuple(features(scene, views, view) for view in range(len(views)))
    return Training(views, (LOGGED,) * len(views), gravity, seen)


def _descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    shares = rng.exponential(1.0, (count, 128))
    return np.rint(512 * np.sqrt(shares / shares.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)
