"""Finished models as arrays over all frames: poses, points, observations and reprojection errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.sfm.cameras.adjustment import Bundle
from groundwalk.sfm.database import image_id

Ints = NDArray[np.int64]

# Features of one blob have its place to the bit; a hundredth allows for rounding.
_SAME_PLACE_PX = 0.01


@dataclass(frozen=True)
class Model:
    """Models as arrays: N frames (rows of the frames table), P points, M observations of a point in a frame.

    A frame is in one model at most; models share no gauge.
    """

    sfm_T_cam: Array
    """(N, 4, 4); NaN where the frame isn't registered."""
    model: Ints
    """(N,) which of the models has the frame, -1: none."""
    point_model: Ints
    """(P,) which of the models the point is from."""
    point_ids: Ints
    """(P,) COLMAP's ids, unique within a model."""
    xyz: Array
    """(P, 3) in the sfm frame of the point's model."""
    rgb: NDArray[np.uint8]
    """(P, 3)"""
    frame: Ints
    """(M,) the row of each observation's frame."""
    point: Ints
    """(M,) the index of its point."""
    observed_px: Array
    """(M, 2) where the point is observed."""
    residual_px: Array
    """(M, 2) where the point is projected minus where it is observed."""

    @property
    def registered(self) -> NDArray[np.bool_]:
        """(N,)"""
        return self.model >= 0

    def part(self, number: int) -> "Model":
        """The model of that number alone, over the same frames."""
        points, observations = self.point_model == number, self.point_model[self.point] == number
        index = np.cumsum(points) - 1
        return Model(
            np.where((self.model == number)[:, None, None], self.sfm_T_cam, np.nan),
            np.where(self.model == number, number, -1),
            self.point_model[points],
            self.point_ids[points],
            self.xyz[points],
            self.rgb[points],
            self.frame[observations],
            index[self.point[observations]],
            self.observed_px[observations],
            self.residual_px[observations],
        )

    def observations(self) -> Ints:
        """How many points each frame sees, (N,)."""
        return np.bincount(self.frame, minlength=len(self.sfm_T_cam))

    def frame_error_px(self) -> Array:
        """Mean length of each frame's residuals, (N,); NaN without observations."""
        return _mean_by(self.frame, np.linalg.norm(self.residual_px, axis=1), len(self.sfm_T_cam))

    def frame_track_length(self) -> Array:
        """Mean track length of the points that each frame sees, (N,); NaN without observations."""
        return _mean_by(self.frame, self.track_lengths()[self.point].astype(float), len(self.sfm_T_cam))

    def frame_triangulation(self) -> Array:
        """Median over the points that each frame sees of their widest angle in radians, (N,)."""
        median = np.full(len(self.sfm_T_cam), np.nan)
        by_frame = pd.Series(self.triangulation_angles()[self.point]).groupby(self.frame).median()
        median[by_frame.index] = by_frame
        return median

    def track_lengths(self) -> Ints:
        """How many frames see each point, (P,)."""
        return np.bincount(self.point, minlength=len(self.xyz))

    def point_error_px(self) -> Array:
        """Mean length of each point's residuals, (P,)."""
        return _mean_by(self.point, np.linalg.norm(self.residual_px, axis=1), len(self.xyz))

    def triangulation_angles(self) -> Array:
        """The widest angle in radians between two rays to each point, (P,)."""
        rays = self.sfm_T_cam[self.frame, :3, 3] - self.xyz[self.point]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        order = np.argsort(self.point, kind="stable")
        lengths = self.track_lengths()
        start = np.concatenate([[0], np.cumsum(lengths)])
        angles = np.zeros(len(self.xyz))
        for length in np.unique(lengths[lengths > 1]):
            points = np.flatnonzero(lengths == length)
            of_points = rays[order[start[points, None] + np.arange(length)]]
            cosine = np.einsum("pix,pjx->pij", of_points, of_points).min(axis=(1, 2))
            angles[points] = np.arccos(np.clip(cosine, -1.0, 1.0))
        return angles


def blobs_of(bundle: Bundle) -> Ints:
    """The number of each point's blob, (P,): SIFT gives a blob a feature for each of its orientations, so points
    that any frame sees in the same place are of one."""
    place = np.round(bundle.observed_px / _SAME_PLACE_PX).astype(np.int64)
    _, blob = np.unique(np.column_stack([bundle.frame, place]), axis=0, return_inverse=True)
    points = len(bundle.xyz)
    size = points + int(blob.max(initial=-1)) + 1
    ties = coo_array((np.ones(len(bundle.point), bool), (bundle.point, points + blob.ravel())), shape=(size, size))
    label = connected_components(ties, directed=False)[1][:points]
    return np.asarray(np.unique(label, return_inverse=True)[1], np.int64).ravel()


def load_models(folders: Sequence[Path], frames: int) -> Model:
    """COLMAP models, of a database made by `create_database` for so many frames, none of which is in two models."""
    models = [_load(folder, number, frames) for number, folder in enumerate(folders)]
    sfm_T_cam, model = models[0].sfm_T_cam, models[0].model
    for other in models[1:]:
        sfm_T_cam = np.where(other.registered[:, None, None], other.sfm_T_cam, sfm_T_cam)
        model = np.maximum(model, other.model)
    offsets = np.cumsum([0, *(len(m.xyz) for m in models)])
    return Model(
        sfm_T_cam,
        model,
        np.concatenate([m.point_model for m in models]),
        np.concatenate([m.point_ids for m in models]),
        np.concatenate([m.xyz for m in models]),
        np.concatenate([m.rgb for m in models]),
        np.concatenate([m.frame for m in models]),
        np.concatenate([m.point + offset for m, offset in zip(models, offsets, strict=False)]),
        np.concatenate([m.observed_px for m in models]),
        np.concatenate([m.residual_px for m in models]),
    )


def pose_of(image: pycolmap.Image) -> Array:
    """sfm_T_cam (4, 4) of a registered image."""
    cam_T_sfm = image.cam_from_world().matrix()
    return inverse(make_pose(cam_T_sfm[:, :3], cam_T_sfm[:, 3]))


def _load(folder: Path, number: int, frames: int) -> Model:
    reconstruction = pycolmap.Reconstruction(folder)
    points = reconstruction.points3D
    point_ids = np.array(sorted(points), np.int64)
    xyz = np.array([points[i].xyz for i in point_ids]).reshape(-1, 3)
    rgb = np.array([points[i].color for i in point_ids], np.uint8).reshape(-1, 3)
    sfm_T_cam = np.full((frames, 4, 4), np.nan)
    frame, point, observed_px, residual = [], [], [], []
    for row in range(frames):
        if not reconstruction.exists_image(image_id(row)):
            continue
        image = reconstruction.image(image_id(row))
        if not image.has_pose:
            continue
        cam_T_sfm = image.cam_from_world().matrix()
        sfm_T_cam[row] = pose_of(image)
        observed = image.get_observation_points2D()
        index = np.searchsorted(point_ids, [p.point3D_id for p in observed])
        in_camera = xyz[index] @ cam_T_sfm[:, :3].T + cam_T_sfm[:, 3]
        camera = reconstruction.camera(image.camera_id)
        projected = np.asarray(camera.img_from_cam(in_camera)).reshape(-1, 2)
        frame.append(np.full(len(observed), row))
        point.append(index)
        observed_px.append(np.array([p.xy for p in observed]).reshape(-1, 2))
        residual.append(projected - observed_px[-1])
    return Model(
        sfm_T_cam,
        np.where(np.isfinite(sfm_T_cam[:, 0, 0]), number, -1),
        np.full(len(point_ids), number),
        point_ids,
        xyz,
        rgb,
        np.concatenate(frame).astype(np.int64),
        np.concatenate(point).astype(np.int64),
        np.concatenate(observed_px),
        np.concatenate(residual),
    )


def _mean_by(group: Ints, values: Array, groups: int) -> Array:
    count = np.bincount(group, minlength=groups)
    with np.errstate(invalid="ignore"):
        return np.bincount(group, values, minlength=groups) / count
