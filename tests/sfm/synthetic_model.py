"""COLMAP's synthetic model of six cameras around some points, and its log as a phone would write it."""

import numpy as np
import pycolmap

from groundwalk.geometry.poses import inverse, make_pose
from groundwalk.sfm.cameras.model_adjustment import CameraLog, camera_log
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.tables import pose_frame
from tests.known import cells


def synthetic_model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=6, num_cameras_per_rig=1, num_frames_per_rig=1, num_points3D=60)
    return pycolmap.synthesize_dataset(options)


def log_of(model: pycolmap.Reconstruction, settings: SfmSettings | None = None) -> CameraLog:
    """The model's cameras as a phone would log them, and its poses as odometry."""
    cam_T_sfm = np.stack([model.image(row + 1).cam_from_world().matrix() for row in range(6)])
    poses = inverse(make_pose(cam_T_sfm[:, :, :3], cam_T_sfm[:, :, 3]))
    frames = pose_frame("vio_cam", poses).assign(session_id="walk", t_ns=np.arange(6) * 1_000_000_000)
    cameras = [model.camera(row + 1) for row in range(6)]
    focal = [camera.mean_focal_length() for camera in cameras]
    frames = frames.assign(first_row="top", fx=focal, fy=focal, cx=cameras[0].width / 2, cy=cameras[0].height / 2)
    frames = frames.assign(
        width=cameras[0].width,
        height=cameras[0].height,
        distortion=cells([[0.0] * 4] * 6),
        stated_readout_s=np.nan,
        focal_sd=0.0,
    )
    log = frames[["session_id", "t_ns", *pose_frame("vio_cam", poses).columns]]
    return camera_log(frames, {"walk": "phone"}, log, log[:0], settings or SfmSettings(lens="stated"))
