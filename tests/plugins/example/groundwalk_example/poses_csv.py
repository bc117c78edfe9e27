"""`poses.csv`: frame, image, position (m) and quaternion xyzw of map_T_cam, with the images in `images/`."""

import csv
from pathlib import Path

from groundwalk.export.dataset import Dataset, Images
from groundwalk.export.exporters import Exporter
from groundwalk.geometry.poses import tq_from_pose


def write(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    position, quaternion = tq_from_pose(dataset.map_T_cam)
    placed = []
    with (folder / "poses.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["frame_id", "image", "tx", "ty", "tz", "qx", "qy", "qz", "qw"])
        for row, frame_id in enumerate(dataset.frames["frame_id"]):
            image = f"images/{frame_id}{dataset.images[row].suffix}"
            dataset.images[row].place(folder / image, images)
            table.writerow([frame_id, image, *position[row].tolist(), *quaternion[row].tolist()])
            placed.append(image)
    return placed


EXPORTER = Exporter(
    id="poses_csv",
    label="poses.csv",
    meaning="poses.csv beside images/",
    write=write,
    distortion_coefficients=None,
)
