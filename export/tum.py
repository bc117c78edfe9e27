"""TUM RGB-D: a folder a session with `groundtruth.txt` (seconds, position, quaternion x y z w) and `rgb.txt`.

Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats (camera-to-world, camera axes as ours). Sessions
have clocks of their own, so each is a sequence of its own. The world is the map: metric, +y up. Images are as the
phone took them, as this benchmark's own are: its tools are given intrinsics and distortion apart from a sequence.
"""

from decimal import Decimal
from pathlib import Path
from urllib.parse import quote

import numpy as np

from groundwalk.export.dataset import Dataset, Images, number
from groundwalk.geometry.poses import tq_from_pose


def write_tum(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    frames = dataset.frames
    position, quaternion = tq_from_pose(dataset.map_T_cam)
    # Nine decimals of nanoseconds, which a float would round.
    seconds = [f"{Decimal(int(t_ns)).scaleb(-9):.9f}" for t_ns in frames["t_ns"]]
    placed = [""] * len(frames)
    for session_id in frames["session_id"].unique():
        name = quote(session_id, safe="")
        rows = np.flatnonzero(frames["session_id"] == session_id)
        rows = rows[np.argsort(frames["t_ns"].to_numpy()[rows], kind="stable")]
        poses, listed = ["# timestamp tx ty tz qx qy qz qw"], ["# timestamp filename"]
        for row in rows:
            image = f"rgb/{seconds[row]}{dataset.images[row].suffix}"
            dataset.images[row].place(folder / name / image, images)
            placed[row] = f"{name}/{image}"
            values = " ".join(number(v) for v in (*position[row], *quaternion[row]))
            poses.append(f"{seconds[row]} {values}")
            listed.append(f"{seconds[row]} {image}")
        (folder / name).mkdir(exist_ok=True)
        for file, lines in (("groundtruth.txt", poses), ("rgb.txt", listed)):
            (folder / name / file).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return placed
