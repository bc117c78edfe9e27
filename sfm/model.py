"""What a finished model says about itself: poses, observations and reprojection errors as arrays over all frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from geometry.poses import Array, inverse, make_pose
from sfm.database import image_id

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Model:
    """A model as arrays: N frames (rows of the frames table), P points, M observations of a point in a frame."""

    sfm_T_cam: Array
    """(N, 4, 4); NaN where the frame isn't registered."""
    point_ids: Ints
    """(P,) COLMAP's ids."""
    xyz: Array
    """(P, 3) in the sfm frame."""
    rgb: NDArray[np.uint8]
    """(P, 3)"""
    frame: Ints
    """(M,) the row of each observation's frame."""
    point: Ints
    """(M,) the index of its point."""
    seen_px: Array
    """(M, 2) where the frame sees it."""
    residual_px: Array
    """(M, 2) where the point is projected minus where it was seen."""

    @property
    def registered(self) -> NDArray[np.bool_]:
        """(N,)"""
        return np.isfinite(self.sfm_T_cam[:, 0, 0])

    def observations(self) -> Ints:
        """How many points each frame sees, (N,)."""
        return np.bincount(self.frame, minlength=len(self.sfm_T_cam))

    def frame_error_px(self) -> Array:
        """Mean length of each frame's residuals, (N,); NaN without observations."""
        return _mean_by(self.frame, np.linalg.norm(self.residual_px, axis=1), len(self.sfm_T_cam))

    def track_lengths(self) -> Ints:
        """How many frames see each point, (P,)."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def point_error_px(self) -> Array:
        """Mean length of each point's residuals, (P,)."""
        return _mean_by(self.point, np.linalg.norm(self.residual_px, axis=1), len(self.xyz))


def load_model(folder: Path, frames: int) -> Model:
    """A COLMAP model of a database made by `create_database` for so many frames."""
    reconstruction = pycolmap.Reconstruction(folder)
    points = reconstruction.points3D
    point_ids = np.array(sorted(points), np.int64)
    xyz = np.array([points[i].xyz for i in point_ids]).reshape(-1, 3)
    rgb = np.array([points[i].color for i in point_ids], np.uint8).reshape(-1, 3)
    sfm_T_cam = np.full((frames, 4, 4), np.nan)
    frame, point, seen_px, residual = [], [], [], []
    for row in range(frames):
        if not reconstruction.exists_image(image_id(row)):
            continue
        image = reconstruction.image(image_id(row))
        if not image.has_pose:
            continue
        cam_T_sfm = image.cam_from_world().matrix()
        sfm_T_cam[row] = inverse(make_pose(cam_T_sfm[:, :3], cam_T_sfm[:, 3]))
        seen = image.get_observation_points2D()
        index = np.searchsorted(point_ids, [p.point3D_id for p in seen])
        in_camera = xyz[index] @ cam_T_sfm[:, :3].T + cam_T_sfm[:, 3]
        camera = reconstruction.camera(image.camera_id)
        projected = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)
        frame.append(np.full(len(seen), row))
        point.append(index)
        seen_px.append(np.array([p.xy for p in seen]).reshape(-1, 2))
        residual.append(projected - seen_px[-1])
    return Model(
        sfm_T_cam,
        point_ids,
        xyz,
        rgb,
        np.concatenate(frame).astype(np.int64),
        np.concatenate(point).astype(np.int64),
        np.concatenate(seen_px),
        np.concatenate(residual),
    )


def _mean_by(group: Ints, values: Array, groups: int) -> Array:
    count = np.bincount(group, minlength=groups)
    with np.errstate(invalid="ignore"):
        return np.bincount(group, values, minlength=groups) / count
