"""Training frames as the map is built from them: poses, cameras and how each camera moved while it was read out."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.geometry.shutter import readout_fraction, readout_lines, sensor_axes, usual_first_row

# Queries whose focal length is within this factor of a lens's are taken with it.
_SAME_LENS = 1.08


@dataclass(frozen=True)
class Lens:
    """The lens of a device: focal length by the longer side of the image, k1, k2, p1, p2, ... as OpenCV has them, the
    readout time of an image, s, and how far its principal point is from the logged one along the sensor's rows and
    columns, by the longer side, too."""

    focal: float
    distortion: tuple[float, ...]
    readout_s: float
    centre: tuple[float, float]


def with_lens(camera: Camera, lenses: tuple[Lens, ...]) -> tuple[Camera, float]:
    """A logged camera with the lens that the map knows for its focal length, and the readout time; the camera as it is,
    and 0, where there is none."""
    focal = (camera.fx + camera.fy) / 2 / max(camera.width, camera.height)
    near = [lens for lens in lenses if 1 / _SAME_LENS < focal / lens.focal < _SAME_LENS]
    if not near:
        return camera, 0.0
    lens = min(near, key=lambda lens: abs(np.log(focal / lens.focal)))
    off_x, off_y = max(camera.width, camera.height) * np.array(lens.centre) @ camera_axes(camera)
    return replace(camera, distortion=lens.distortion, cx=camera.cx + off_x, cy=camera.cy + off_y), lens.readout_s


def camera_axes(camera: Camera) -> Array:
    """(2, 2) along what the sensor's rows and columns run in a camera's image."""
    return np.asarray(sensor_axes(_readout_line(camera)[None])[0])


@dataclass(frozen=True)
class Views:
    """N frames with known poses map_T_cam (N, 4, 4) of their middle rows, in metres; their cameras; readout time of the
    whole image (N,), s; angular velocity (N, 3), rad/s, and velocity (N, 3), m/s, in the camera's axes."""

    map_T_cam: Array
    cameras: tuple[Camera, ...]
    readout_s: Array
    angular: Array
    velocity: Array

    def __len__(self) -> int:
        return len(self.cameras)


def row_times(px_M2: Array, camera: Camera, readout_s: float) -> Array:
    """When pixels (M, 2) were exposed after the middle row, (M,), s."""
    return readout_s * readout_fraction(_readout_line(camera), px_M2)


def _readout_line(camera: Camera) -> Array:
    first_row = camera.first_row or usual_first_row(camera.width, camera.height)
    return readout_lines([first_row], camera.width, camera.height)[0]


def rays_of(views: Views, view: int, px_M2: Array) -> tuple[Array, Array]:
    """Where pixels (M, 2) of a frame were seen from and in which direction, both (M, 3) in the map; the directions are
    of unit depth, NaN where the lens has none."""
    camera, map_T_cam = views.cameras[view], views.map_T_cam[view]
    time_s = row_times(px_M2, camera, float(views.readout_s[view]))[:, None]
    ideal = camera.unproject(px_M2)
    cam = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    # Rows are read out within 30 ms: a turn of some milliradians, to first order.
    cam = cam + time_s * np.cross(views.angular[view], cam)
    origin = map_T_cam[:3, 3] + (time_s * views.velocity[view]) @ map_T_cam[:3, :3].T
    return origin, cam @ map_T_cam[:3, :3].T


def subset(views: Views, rows: NDArray[np.int64]) -> Views:
    """Some of the views."""
    cameras = tuple(views.cameras[row] for row in rows.tolist())
    return Views(views.map_T_cam[rows], cameras, views.readout_s[rows], views.angular[rows], views.velocity[rows])
