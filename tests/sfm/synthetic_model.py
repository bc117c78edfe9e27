"""COLMAP's synthetic model of six cameras around some points, and its log as a phone would write it."""

import numpy as np
import pandas as pd
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
    frames = frames_of(model)
    log = frames.filter(regex="session_id|t_ns|vio_cam")
    return camera_log(frames, {"walk": "phone"}, log, log[:0], settings or SfmSettings(lens="stated"))


def frames_of(model: pycolmap.Reconstruction) -> pd.DataFrame:
    """The model's images as import's frames of one session."""
    count = model.num_images()
    cam_T_sfm = np.stack([model.image(row + 1).cam_from_world().matrix() for row in range(count)])
    poses = inverse(make_pose(cam_T_sfm[:, :, :3], cam_T_sfm[:, :, 3]))
    frames = pose_frame("vio_cam", poses).assign(session_id="walk", t_ns=np.arange(count) * 1_000_000_000)
    cameras = [model.camera(model.image(row + 1).camera_id) for row in range(count)]
    focal = [camera.mean_focal_length() for camera in cameras]
    frames = frames.assign(first_row="top", fx=focal, fy=focal, cx=cameras[0].width / 2, cy=cameras[0].height / 2)
    return frames.assign(
        frame_id=[f"walk/{row:06d}" for row in range(count)],
        image=[f"walk/{row:06d}.jpg" for row in range(count)],
        width=cameras[0].width,
        height=cameras[0].height,
        distortion=cells([[0.0] * 4] * count),
        stated_readout_s=np.nan,
        focal_sd=0.0,
    )
