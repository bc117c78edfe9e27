"""nerfstudio: `transforms.json` and `images/`.

Format: https://docs.nerf.studio/quickstart/data_conventions.html. `transform_matrix` is camera-to-world with OpenGL's
camera axes (y up, looking along -z) in a world with +z up; `applied_transform` says how that world came from ours.
Intrinsics are each frame's own, k1 to k3, p1 and p2 with them; images with further coefficients are written as those
of a pinhole. Splits are in `train_filenames`, `val_filenames` and `test_filenames`.
"""

import json
from collections.abc import Sequence
from pathlib import Path

from groundwalk.export.colmap import place_images
from groundwalk.export.dataset import WORLD_T_MAP, Dataset, Images
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, inverse, make_pose

# OpenGL's camera axes are ARKit's.
_OPENGL_CAM_T_CAM = ARKIT_CAM_T_CAM
# OpenCV's order of coefficients.
DISTORTION = ("k1", "k2", "p1", "p2", "k3")


def write_nerfstudio(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    placed = place_images(dataset, folder, dataset.image_names, images)
    write_transforms(dataset, folder, placed)
    return placed


def write_transforms(
    dataset: Dataset, folder: Path, placed: Sequence[str], camera_model: str = "OPENCV", **more: str
) -> None:
    """Write `transforms.json` of the frames that have an image path, with `more` of what it says of them all."""
    world_T_cam = WORLD_T_MAP @ dataset.map_T_cam @ _OPENGL_CAM_T_CAM
    frames = []
    for row, path, pose in zip(dataset.frames.to_dict("records"), placed, world_T_cam, strict=True):
        if not path:
            continue
        coefficients = [float(k) for k in row["distortion"]] + [0.0] * len(DISTORTION)
        frames.append(
            {
                "file_path": path,
                "fl_x": row["fx"],
                "fl_y": row["fy"],
                "cx": row["cx"],
                "cy": row["cy"],
                "w": row["width"],
                "h": row["height"],
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
