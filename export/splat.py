"""Gaussian splatting: undistorted `images/` of one centred pinhole a device, COLMAP's `sparse/0` with points, and
nerfstudio's `transforms.json` with the same points as `points.ply`.

Read by `train.py -s` of https://github.com/graphdeco-inria/gaussian-splatting, which takes PINHOLE cameras and puts
their principal point into the middle; by gsplat's examples; by nerfstudio's splatfacto. Images lie in one folder, as
some of their descendants drop the name of a folder below. Only the largest of SfM's models is written: others share no
view with it. The world of `sparse/0` is the map, +y up; that of `transforms.json` and `points.ply` has +z up. An image
is seen from the pose of its middle row; its rolling shutter stays in it.
"""

from pathlib import Path
from urllib.parse import quote

import numpy as np
import pycolmap

from groundwalk.export.colmap import model_in_map, place_images, write_model, write_splits
from groundwalk.export.dataset import WORLD_T_MAP, Dataset, Images
from groundwalk.export.nerfstudio import write_transforms


def write_splat(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths, "" for those outside of the largest of SfM's models."""
    largest, names = dataset.models[0], [""] * len(dataset.frames)
    for row in np.flatnonzero(dataset.frames["frame_id"].isin(largest.frame_ids)):
        session, _, count = dataset.frames["frame_id"].iloc[row].rpartition("/")
        names[row] = f"{quote(session, safe='')}-{count}{dataset.images[row].suffix}"
    model = model_in_map(dataset, largest, names)
    write_model(model, folder / "sparse" / "0")
    write_splits(dataset, folder, names)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(WORLD_T_MAP[:3, :3]), WORLD_T_MAP[:3, 3]))
    model.export_PLY(folder / "points.ply")
    placed = place_images(dataset, folder, names, images)
    write_transforms(dataset, folder, placed, camera_model="PINHOLE", ply_file_path="points.ply")
    return placed
