"""Cambridge Landmarks: `seq1/frame00000.jpg`, `dataset_train.txt`, `dataset_test.txt` and `reconstruction.nvm`.

Format: https://www.repository.cam.ac.uk/handle/1810/251342 (position, then the world-to-camera rotation as quaternion
w x y z; camera axes as ours) and http://ccwu.me/vsfm/doc.html#nvm. The .nvm holds the cameras and no points. Its
readers take the principal point to be the image's centre and none of the distortion that it has a place for, so images
with distortion are written as those of such a pinhole. Of other images' intrinsics it holds the mean of fx and fy.
"""

from pathlib import Path

import numpy as np

from groundwalk.export.dataset import Dataset, Images, number
from groundwalk.geometry.poses import inverse, quaternion_from_matrix

_HEADER = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"


def write_cambridge(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the frames' image paths."""
    position = dataset.map_T_cam[:, :3, 3]
    quaternion = quaternion_from_matrix(inverse(dataset.map_T_cam)[:, :3, :3])[:, [3, 0, 1, 2]]
    placed = [""] * len(dataset.frames)
    lists: dict[bool, list[str]] = {False: [], True: []}
    for index, (test, rows) in enumerate(dataset.sequences(), start=1):
        for count, row in enumerate(rows):
            placed[row] = f"seq{index}/frame{count:05d}{dataset.images[row].suffix}"
            dataset.images[row].place(folder / placed[row], images)
            values = " ".join(number(v) for v in (*position[row], *quaternion[row]))
            lists[test].append(f"{placed[row]} {values}\n")
    for test, name in ((False, "dataset_train.txt"), (True, "dataset_test.txt")):
        (folder / name).write_text(_HEADER + "".join(lists[test]), encoding="ascii")

    order = np.argsort(placed)
    focal = dataset.frames[["fx", "fy"]].to_numpy(float).mean(axis=1)
    cameras = [
        " ".join([placed[row], *(number(v) for v in (focal[row], *quaternion[row], *position[row], 0.0)), "0"])
        for row in order
    ]
    nvm = "\n".join(["NVM_V3", "", str(len(cameras)), *cameras, "", "0", "", "0", ""])
    (folder / "reconstruction.nvm").write_text(nvm, encoding="ascii")
    return placed
