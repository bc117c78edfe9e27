"""Models that mapping built: their records, in a file beside them; and finished ones as arrays over all frames, with
poses, points, observations and reprojection errors."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import Ints, image_id, pose_of

_FILE = "built.json"


@dataclass(frozen=True)
class BuiltModel:
    """A model that mapping built: by which mapping, its number there, its size, the rows of frames that were taken out
    as misplaced, what its images say of stated lenses (`mapping.stated.StatedCheck`), and, where it was selected, its
    folder; beside that `<folder>.npz` has what `groundwalk.sfm.cameras.model_adjustment.load_adjusted` reads."""

    mapping: str
    number: int
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_px: float
    misplaced: Sequence[int] = ()
    folder: str = ""
    stated: Sequence[dict[str, Any]] = ()

    @property
    def model_id(self) -> str:
        return f"{self.mapping}/{self.number}"

    @staticmethod
    def of(mapping: str, number: int, model: pycolmap.Reconstruction) -> "BuiltModel":
        """The record of a model, which isn't selected."""
        sizes = model.num_reg_images(), model.num_points3D(), model.compute_num_observations()
        means = model.compute_mean_track_length(), model.compute_mean_reprojection_error()
        return BuiltModel(mapping, number, *sizes, *means)


def write_built(folder: Path, built: Sequence[BuiltModel]) -> None:
    (folder / _FILE).write_text(json.dumps([asdict(one) for one in built]), encoding="utf-8")


def read_built(output: Path) -> list[BuiltModel]:
    """The models in the order in which they were built."""
    return [BuiltModel(**entry) for entry in json.loads((output / _FILE).read_text(encoding="utf-8"))]


def selected_models(built: Sequence[BuiltModel]) -> list[BuiltModel]:
    """The models that were selected, the largest first."""
    return sorted((entry for entry in built if entry.folder), key=lambda entry: (len(entry.folder), entry.folder))


@dataclass(frozen=True)
class Model:
    """Models as arrays: N frames (rows of the frames table), P points, M observations of a point in a frame. A frame is
    in one model at most; models share no gauge.

    `sfm_T_cam` (N, 4, 4) is NaN where the frame isn't registered; `model` (N,) says which of the models has it, -1
    none. Of points: the number of their model (P,), COLMAP's ids (P,), unique within a model, and place in its sfm
    frame and colour (P, 3). Of observations: the row of its frame and the index of its point (M,), where the point is
    observed and where it is projected minus that (M, 2).
    """

    sfm_T_cam: Array
    model: Ints
    point_model: Ints
    point_ids: Ints
    xyz: Array
    rgb: NDArray[np.uint8]
    frame: Ints
    point: Ints
    observed_px: Array
    residual_px: Array

    @property
    def registered(self) -> NDArray[np.bool_]:
        """(N,)"""
        return self.model >= 0

    @property
    def track_lengths(self) -> Ints:
        """(P,) how many frames see each point."""
        return np.bincount(self.point, minlength=len(self.xyz))

    @property
    def mean_error_px(self) -> float:
        """Mean length of all residuals."""
        return float(np.linalg.norm(self.residual_px, axis=1).mean())

    def of_frames(self) -> pd.DataFrame:
        """A row a frame: the points that it sees (`observations`), and of these the mean track length and the mean
        length of residuals (`reprojection_px`); NaN for none."""
        seen = pd.DataFrame(
            {
                "track_length": self.track_lengths[self.point],
                "reprojection_px": np.linalg.norm(self.residual_px, axis=1),
            }
        ).groupby(self.frame)
        table = seen.mean().assign(observations=seen.size())
        table = table.reindex(range(len(self.sfm_T_cam)))
        return table.assign(observations=table["observations"].fillna(0).astype(np.int64))

    def point_error_px(self) -> Array:
        """Mean length of each point's residuals, (P,)."""
        return np.bincount(self.point, np.linalg.norm(self.residual_px, axis=1), len(self.xyz)) / self.track_lengths


def renumbered(folder: Path, names: Sequence[str]) -> pycolmap.Reconstruction:
    """A COLMAP model with the ids that `create_database` gives its images among frames of these names; images that
    aren't among them are left out, and so are the points that fewer than two of the others see."""
    source, model = pycolmap.Reconstruction(folder), pycolmap.Reconstruction()
    row_of = {name: row for row, name in enumerate(names)}
    id_of = {i: image_id(row_of[name]) for i in source.reg_image_ids() if (name := source.image(i).name) in row_of}
    for old_id, new_id in id_of.items():
        add_image(model, source, old_id, new_id)
    for point_id, point in source.points3D.items():
        seen = [(id_of[e.image_id], e.point2D_idx) for e in point.track.elements if e.image_id in id_of]
        if len({i for i, _ in seen}) > 1:
            track = pycolmap.Track([pycolmap.TrackElement(*element) for element in seen])
            model.add_point3D_with_id(
                point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
            )
            for i, feature in seen:
                model.image(i).set_point3D_for_point2D(feature, point_id)
    return model


def add_image(model: pycolmap.Reconstruction, source: pycolmap.Reconstruction, old_id: int, new_id: int) -> None:
    """Add an image that another model has registered, with its camera and pose, but none of the points it sees."""
    image = source.image(old_id)
    camera = source.camera(image.camera_id)
    camera.camera_id = new_id
    model.add_camera_with_trivial_rig(camera)
    keypoints = np.array([p.xy for p in image.points2D]).reshape(-1, 2)
    added = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=new_id, image_id=new_id)
    model.add_image_with_trivial_frame(added, image.cam_from_world())


def load_models(folders: Sequence[Path], frames: int) -> Model:
    """COLMAP models, of a database made by `create_database` for so many frames, none of which is in two models."""
    sfm_T_cam, model = np.full((frames, 4, 4), np.nan), np.full(frames, -1)
    of_points, of_observations, first_point = [], [], 0
    for number, folder in enumerate(folders):
        reconstruction = pycolmap.Reconstruction(folder)
        points = reconstruction.points3D
        ids = np.array(sorted(points), np.int64)
        xyz = np.array([points[i].xyz for i in ids]).reshape(-1, 3)
        rgb = np.array([points[i].color for i in ids], np.uint8).reshape(-1, 3)
        of_points.append((np.full(len(ids), number), ids, xyz, rgb))
        for row in sorted(i - 1 for i in reconstruction.reg_image_ids()):
            image = reconstruction.image(image_id(row))
            sfm_T_cam[row], model[row] = pose_of(image), number
            seen = image.get_observation_points2D()
            index = np.searchsorted(ids, [p.point3D_id for p in seen])
            cam_T_sfm = image.cam_from_world().matrix()
            in_camera = xyz[index] @ cam_T_sfm[:, :3].T + cam_T_sfm[:, 3]
            projected = np.asarray(reconstruction.camera(image.camera_id).img_from_cam(in_camera)).reshape(-1, 2)
            observed_px = np.array([p.xy for p in seen]).reshape(-1, 2)
            of_image = np.full(len(seen), row), first_point + index, observed_px, projected - observed_px
            of_observations.append(of_image)
        first_point += len(ids)
    columns = [*zip(*of_points, strict=True), *zip(*of_observations, strict=True)]
    return Model(sfm_T_cam, model, *map(np.concatenate, columns))
