"""kapture 1.1: `mapping/` and, of test frames, `query/`, each with `sensors/`, which has the images in `records_data/`.

Format: https://github.com/naver/kapture/blob/main/kapture_format.adoc (world-to-camera poses, quaternion w first;
COLMAP's cameras; names without commas). A timestamp is a frame's row among those exported, as clocks of sessions have
different starts and kapture's are of 32 bits; `frames.csv` has the capture times. The world is the map: metric, +y up.
"""

from pathlib import Path
from urllib.parse import quote

import numpy as np

from groundwalk.export.colmap import camera_fields
from groundwalk.export.dataset import Dataset, Images, number
from groundwalk.geometry.poses import inverse, tq_from_pose

_VERSION = "# kapture format: 1.1"


def write_kapture(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    frames, placed = dataset.frames, [""] * len(dataset.frames)
    cameras, names = [", ".join(camera_fields(camera)) for camera in dataset.cameras], dataset.image_names
    position, quaternion = tq_from_pose(inverse(dataset.map_T_cam))
    for name, in_part in (("mapping", ~dataset.in_test), ("query", dataset.in_test)):
        rows, sensors, poses, records = np.flatnonzero(in_part), dict[str, str](), list[str](), list[str]()
        for row in rows:
            session_id = frames["session_id"].iloc[row]
            # Frames share a camera where focus and lens stayed the same.
            device = sensors.setdefault(f"{session_id}\n{cameras[row]}", f"{quote(session_id, safe='')}-{len(sensors)}")
            x, y, z, w = quaternion[row]
            poses.append(", ".join([str(row), device, *map(number, (w, x, y, z, *position[row]))]))
            records.append(f"{row}, {device}, {names[row]}")
            placed[row] = f"{name}/sensors/records_data/{names[row]}"
            dataset.images[row].place(folder / placed[row], images)
        if not len(rows):
            continue
        listed = [f"{device}, , camera, {key.partition(chr(10))[2]}" for key, device in sensors.items()]
        world = f"# world: the map, {dataset.world}"
        for file, head, lines in (
            ("sensors", ["# sensor_device_id, name, sensor_type, [sensor_params]+"], listed),
            ("trajectories", [world, "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"], poses),
            ("records_camera", ["# timestamp, device_id, image_path"], records),
        ):
            path = folder / name / "sensors" / f"{file}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("\n".join([_VERSION, *head, *lines]) + "\n", encoding="utf-8")
    return placed
