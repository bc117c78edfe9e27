"""nerfstudio: `transforms.json` and `images/`.

Format: https://docs.nerf.studio/quickstart/data_conventions.html. `transform_matrix` is camera-to-world with OpenGL's
camera axes (y up, looking along -z) in a world with +z up; `applied_transform` says how that world came from ours.
Intrinsics are each frame's own, k1 to k3, p1 and p2 with them; images with further coefficients are written as those
of a pinhole. Splits are in `train_filenames`, `val_filenames` and `test_filenames`.
"""

import json
from pathlib import Path
from urllib.parse import quote

import numpy as np

from groundwalk.export.dataset import Dataset, Images
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, inverse, make_pose

# OpenGL's camera axes are ARKit's.
_OPENGL_CAM_T_CAM = ARKIT_CAM_T_CAM
# From +y up to +z up: a quarter turn about x.
_WORLD_T_MAP = make_pose([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], np.zeros(3))
# OpenCV's order of coefficients.
DISTORTION = ("k1", "k2", "p1", "p2", "k3")


def write_nerfstudio(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    world_T_cam = _WORLD_T_MAP @ dataset.map_T_cam @ _OPENGL_CAM_T_CAM
    frames, placed = [], []
    rows = dataset.frames.to_dict("records")
    for row, source, pose in zip(rows, dataset.images, world_T_cam, strict=True):
        placed.append(f"images/{quote(row['frame_id'], safe='/')}{source.suffix}")
        source.place(folder / placed[-1], images)
        coefficients = [float(k) for k in row["distortion"]] + [0.0] * len(DISTORTION)
        frames.append(
            {
                "file_path": placed[-1],
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
        "camera_model": "OPENCV",
        "applied_transform": _WORLD_T_MAP[:3].tolist(),
        **{
            f"{name}_filenames": [path for path, of in zip(placed, split, strict=True) if of == name]
            for name in ("train", "val", "test")
        },
        "frames": frames,
    }
    if (place := dataset.georeference) is not None:
        enu_S_map = place.enu_S_map
        enu_T_world = make_pose(enu_S_map.rotation, enu_S_map.translation) @ inverse(_WORLD_T_MAP)
        content["georeference"] = {
            "origin": place.origin,
            "scale": enu_S_map.scale,
            "enu_T_world": enu_T_world.tolist(),
        }
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return placed
