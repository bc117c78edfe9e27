"""Sequences of images with poses: TUM RGB-D, EuRoC, 7-Scenes and Cambridge Landmarks. Camera axes are ours in all.

TUM and EuRoC have a folder a session, as sessions have clocks of their own; 7-Scenes and Cambridge Landmarks a sequence
for each session's part in training or test.
"""

from decimal import Decimal
from pathlib import Path
from urllib.parse import quote

import numpy as np

from groundwalk.export.dataset import WORLD_T_MAP, Dataset, Images, numbers, write_lines
from groundwalk.geometry.cameras import CENTRE_OF_FIRST_PIXEL, Camera
from groundwalk.geometry.poses import inverse, quaternion_from_matrix, tq_from_pose
from groundwalk.store import UserError
from groundwalk.store.tables import map_unit

_POSES = "#timestamp [ns],p_x [{0}],p_y [{0}],p_z [{0}],q_w [],q_x [],q_y [],q_z []"
_HEADER = ("Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", "")


def write_tum(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """TUM RGB-D, `groundtruth.txt` and `rgb.txt`; returns the frames' image paths.

    Format: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats (seconds, position, quaternion x y z w,
    camera to world). The world is the map. Images are as the phone took them, as this benchmark's own are: its tools
    are given intrinsics and distortion apart from a sequence.
    """
    frames, placed = dataset.frames, [""] * len(dataset.frames)
    position, quaternion = tq_from_pose(dataset.map_T_cam)
    # Nine decimals of nanoseconds, which a float would round.
    seconds = [f"{Decimal(int(t_ns)).scaleb(-9):.9f}" for t_ns in frames["t_ns"]]
    for session_id, of_session in frames.groupby("session_id", sort=False):
        name, rows = quote(str(session_id), safe=""), of_session.sort_values("t_ns", kind="stable").index
        poses, listed = ["# timestamp tx ty tz qx qy qz qw"], ["# timestamp filename"]
        for row in rows:
            image = f"rgb/{seconds[row]}{dataset.images[row].suffix}"
            dataset.images[row].place(folder / name / image, images)
            placed[row] = f"{name}/{image}"
            poses.append(f"{seconds[row]} {numbers(*position[row], *quaternion[row])}")
            listed.append(f"{seconds[row]} {image}")
        write_lines(folder / name / "groundtruth.txt", poses)
        write_lines(folder / name / "rgb.txt", listed)
    return placed


def write_euroc(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """EuRoC, `mav0/cam0` and `mav0/state_groundtruth_estimate0`; returns the frames' image paths. UserError where a
    session has several cameras.

    Format: https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets (nanoseconds, body to world,
    quaternion w first). The body is the camera; the world has +z up. A session has one camera, so its images are those
    of one pinhole. There is no IMU, and of the ground truth no velocity or bias.
    """
    placed, cameras = [""] * len(dataset.frames), dataset.cameras
    position, quaternion = tq_from_pose(WORLD_T_MAP @ dataset.map_T_cam)
    for session_id, of_session in dataset.frames.groupby("session_id", sort=True):
        rows, own = of_session.sort_values("t_ns").index.to_numpy(), {cameras[row] for row in of_session.index}
        if len(own) > 1:
            raise UserError(
                "EuRoC has one camera a session",
                where=session_id,
                found=f"{len(own)}: other lenses, or focal lengths from {min(c.fx for c in own):.0f} to "
                f"{max(c.fx for c in own):.0f} px",
                do="export as splat or tum, or record the session with one lens, without zoom",
            )
        session = folder / quote(str(session_id), safe="") / "mav0"
        listed, poses = ["#timestamp [ns],filename"], [_POSES.format(map_unit(dataset.frames).symbol)]
        for row in rows:
            t_ns = dataset.frames["t_ns"].iloc[row]
            listed.append(f"{t_ns},{t_ns}.png")
            poses.append(f"{t_ns},{numbers(*position[row], *np.roll(quaternion[row], 1), separator=',')}")
            image = session / "cam0" / "data" / f"{t_ns}.png"
            placed[row] = image.relative_to(folder).as_posix()
            dataset.images[row].place(image, images)
        write_lines(session / "cam0" / "data.csv", listed)
        write_lines(session / "cam0" / "sensor.yaml", _sensor(cameras[rows[0]]))
        write_lines(session / "state_groundtruth_estimate0" / "data.csv", poses)
    return placed


def _sensor(camera: Camera) -> list[str]:
    """Lines of `sensor.yaml`."""
    cx, cy = camera.cx - CENTRE_OF_FIRST_PIXEL, camera.cy - CENTRE_OF_FIRST_PIXEL
    return [
        *("sensor_type: camera", "T_BS:", "  cols: 4", "  rows: 4"),
        f"  data: [{numbers(*np.eye(4).ravel(), separator=', ')}]",
        f"resolution: [{camera.width}, {camera.height}]",
        "camera_model: pinhole",
        f"intrinsics: [{numbers(camera.fx, camera.fy, cx, cy, separator=', ')}]",
        "distortion_model: radial-tangential",
        "distortion_coefficients: [0.0, 0.0, 0.0, 0.0]",
    ]


def write_seven_scenes(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """7-Scenes, `seq-01/frame-000000.color.png` with `.pose.txt`, and the splits; returns the frames' image paths.

    Format: https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes (4x4, camera to world). It has no
    intrinsics: each frame's 3x3 matrix lies beside it in `.intrinsics.txt`. It has no distortion either, so images that
    have some are those of a pinhole. There are no depth images. Images are PNG, so JPEGs are decoded and written anew.
    """
    cameras, placed = dataset.cameras, [""] * len(dataset.frames)
    splits: dict[bool, list[str]] = {False: [], True: []}
    for index, (test, rows) in enumerate(dataset.sequences(), start=1):
        splits[test].append(f"sequence{index}")
        sequence = folder / f"seq-{index:02d}"
        for count, row in enumerate(rows):
            stem = f"frame-{count:06d}"
            for kind, matrix in (("pose", dataset.map_T_cam[row]), ("intrinsics", cameras[row].matrix)):
                write_lines(sequence / f"{stem}.{kind}.txt", [numbers(*values, separator="\t") for values in matrix])
            dataset.images[row].place(sequence / f"{stem}.color.png", images)
            placed[row] = f"{sequence.name}/{stem}.color.png"
    write_lines(folder / "TrainSplit.txt", splits[False])
    write_lines(folder / "TestSplit.txt", splits[True])
    return placed


def write_cambridge(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Cambridge Landmarks, `seq1/frame00000.jpg`, the lists and `reconstruction.nvm`; returns the frames' image paths.

    Format: https://www.repository.cam.ac.uk/handle/1810/251342 (position, then the world-to-camera rotation as
    quaternion w x y z) and http://ccwu.me/vsfm/doc.html#nvm. The .nvm holds the cameras and no points. Its readers take
    the principal point to be the image's centre and none of the distortion that it has a place for, so images with
    distortion are those of such a pinhole. Of other images' intrinsics it holds the mean of fx and fy.
    """
    position = dataset.map_T_cam[:, :3, 3]
    quaternion = quaternion_from_matrix(inverse(dataset.map_T_cam)[:, :3, :3])[:, [3, 0, 1, 2]]
    placed = [""] * len(dataset.frames)
    lists: dict[bool, list[str]] = {False: [], True: []}
    for index, (test, rows) in enumerate(dataset.sequences(), start=1):
        for count, row in enumerate(rows):
            placed[row] = f"seq{index}/frame{count:05d}{dataset.images[row].suffix}"
            dataset.images[row].place(folder / placed[row], images)
            lists[test].append(f"{placed[row]} {numbers(*position[row], *quaternion[row])}")
    write_lines(folder / "dataset_train.txt", [*_HEADER, *lists[False]])
    write_lines(folder / "dataset_test.txt", [*_HEADER, *lists[True]])

    focal = dataset.frames[["fx", "fy"]].to_numpy(float).mean(axis=1)
    cameras = [
        f"{placed[row]} {numbers(focal[row], *quaternion[row], *position[row], 0.0)} 0" for row in np.argsort(placed)
    ]
    write_lines(folder / "reconstruction.nvm", ["NVM_V3", "", str(len(cameras)), *cameras, "", "0", "", "0"])
    return placed
