"""nerfstudio: `transforms.json` and `images/`; and Gaussian splatting, which has COLMAP's model, too.

Format: https://docs.nerf.studio/quickstart/data_conventions.html. `transform_matrix` is camera-to-world with OpenGL's
camera axes (y up, looking along -z) in a world with +z up; `applied_transform` says how that world came from ours.
Intrinsics are each frame's own, k1 to k3, p1 and p2 with them; images with further coefficients are those of a pinhole.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pycolmap

from groundwalk.export.colmap import model_in_map, place_images, write_model, write_splits
from groundwalk.export.dataset import WORLD_T_MAP, Dataset, Images
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, inverse, make_pose

# OpenCV's order of coefficients.
DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}


def write_nerfstudio(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    placed = place_images(dataset, folder, dataset.image_names, images)
    write_transforms(dataset, folder, placed)
    return placed


def write_transforms(
    dataset: Dataset, folder: Path, placed: Sequence[str], camera_model: str = "OPENCV", **more: str
) -> None:
    """Write `transforms.json` of the frames that have an image path, with `more` of what it says of them all."""
    world_T_cam = WORLD_T_MAP @ dataset.map_T_cam @ ARKIT_CAM_T_CAM  # OpenGL's camera axes are ARKit's
    frames = []
    for row, path, pose in zip(dataset.frames.to_dict("records"), placed, world_T_cam, strict=True):
        if not path:
            continue
        coefficients = [float(k) for k in row["distortion"]] + [0.0] * len(DISTORTION)
        frames.append(
            {
                "file_path": path,
                **{key: row[column] for key, column in _INTRINSICS.items()},
                **dict(zip(DISTORTION, coefficients, strict=False)),
                "transform_matrix": pose.tolist(),
            }
        )
    split = dataset.frames["split"]
    content = {
        "camera_model": camera_model,
        **more,
        "applied_transform": WORLD_T_MAP[:3].tolist(),
        **{
            f"{name}_filenames": [path for path, of in zip(placed, split, strict=True) if path and of == name]
            for name in ("train", "val", "test")
        },
        "frames": frames,
    }
    if (place := dataset.georeference) is not None:
        enu_S_map = place.enu_S_map
        enu_T_world = make_pose(enu_S_map.rotation, enu_S_map.translation) @ inverse(WORLD_T_MAP)
        content["georeference"] = {
            "origin": place.origin,
            "scale": enu_S_map.scale,
            "enu_T_world": enu_T_world.tolist(),
        }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_splat(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Undistorted `images/` of one centred pinhole a device, COLMAP's `sparse/0` with points, and `transforms.json`
    with the same points as `points.ply`; returns the frames' image paths, "" for those outside of the largest of SfM's
    models, as others share no view with it.

    Read by `train.py -s` of https://github.com/graphdeco-inria/gaussian-splatting, which takes PINHOLE cameras and puts
    their principal point into the middle; by gsplat's examples; by nerfstudio's splatfacto. Images lie in one folder,
    as some of their descendants drop the name of a folder below. The world of `sparse/0` is the map, +y up; that of
    `transforms.json` and `points.ply` has +z up. An image's rolling shutter stays in it.
    """
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
