"""7-Scenes: `seq-01/frame-000000.color.png` with `.pose.txt`, `TrainSplit.txt` and `TestSplit.txt`.

Format: https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes (4x4 camera-to-world, camera axes as
ours). It has no intrinsics and no depth of ours to hold: each frame's 3x3 matrix lies beside it in
`.intrinsics.txt`, and there are no depth images. It has no distortion either, so images that have some are written as
those of a pinhole. Images are PNG, so JPEGs are decoded and written anew.
"""

from pathlib import Path

import numpy as np

from groundwalk.export.dataset import Dataset, Images, number
from groundwalk.geometry.poses import Array


def write_seven_scenes(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    intrinsics = dataset.frames[["fx", "fy", "cx", "cy"]].to_numpy(float)
    placed = [""] * len(dataset.frames)
    splits: dict[bool, list[str]] = {False: [], True: []}
    for index, (test, rows) in enumerate(dataset.sequences(), start=1):
        splits[test].append(f"sequence{index}\n")
        sequence = folder / f"seq-{index:02d}"
        sequence.mkdir()
        for count, row in enumerate(rows):
            stem = f"frame-{count:06d}"
            fx, fy, cx, cy = intrinsics[row]
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            (sequence / f"{stem}.pose.txt").write_text(_rows(dataset.map_T_cam[row]), encoding="ascii")
            (sequence / f"{stem}.intrinsics.txt").write_text(_rows(matrix), encoding="ascii")
            dataset.images[row].place(sequence / f"{stem}.color.png", images)
            placed[row] = f"{sequence.name}/{stem}.color.png"
    for test, name in ((False, "TrainSplit.txt"), (True, "TestSplit.txt")):
        (folder / name).write_text("".join(splits[test]), encoding="ascii")
    return placed


def _rows(matrix: Array) -> str:
    return "".join("\t".join(number(v) for v in row) + "\n" for row in matrix)
