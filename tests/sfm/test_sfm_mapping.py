from pathlib import Path

import numpy as np
import pycolmap
import pytest
from known import cells
from scipy.linalg import LinAlgError

from groundwalk.artefacts.tables import pose_frame
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.sfm.cameras.model_adjustment import CameraLog, adjust_model, camera_log, with_lenses_of
from groundwalk.sfm.model import load_models
from groundwalk.sfm.settings import SfmSettings


def test_points_behind_a_camera_are_taken_out(tmp_path: Path) -> None:
    model = _model()
    behind, image_id = next((p, t.image_id) for p, point in model.points3D.items() for t in point.track.elements)
    centre = model.image(image_id).projection_center()
    model.point3D(behind).xyz = 2 * centre - model.point3D(behind).xyz

    model.write_binary(tmp_path)
    adjusted, rows = adjust_model(model, _keypoints(model), _log(model), SfmSettings(refine_cameras="never"))

    model.write_binary(tmp_path)
    left = load_models([tmp_path], 6)
    assert rows.tolist() == list(range(6)) and np.isfinite(adjusted.loss_px)
    assert np.isfinite(left.residual_px).all() and np.isfinite(left.point_error_px()).all()
    assert left.registered.all() and len(left.xyz) >= 59


def test_a_frame_with_hardly_an_observation_is_deregistered() -> None:
    model = _model()
    _leave(model, 6, 5)
    adjusted, rows = adjust_model(model, _keypoints(model), _log(model), SfmSettings())
    assert rows.tolist() == list(range(5)) == [frame_id - 1 for frame_id in sorted(model.reg_frame_ids())]
    assert len(adjusted.bundle.sfm_T_cam) == 5 and np.isfinite(adjusted.bundle.sfm_T_cam).all()


def test_a_model_of_a_handful_of_observations_is_not_determined() -> None:
    model = _model()
    for image_id in range(1, 7):
        _leave(model, image_id, 5)
    with pytest.raises(LinAlgError, match="hardly any frame"):
        adjust_model(model, _keypoints(model), _log(model), SfmSettings())


def test_further_models_start_from_the_lens_of_the_largest() -> None:
    model, settings = _model(), SfmSettings()
    log = _log(model, settings)
    adjusted, rows = adjust_model(model, _keypoints(model), log, settings)
    (before,), (after,) = log.calibration.lenses, with_lenses_of(log, adjusted, rows).calibration.lenses
    assert after.prior_coefficients == adjusted.cameras.coefficients[0].tolist() != before.prior_coefficients
    assert after.prior_readout_s == adjusted.cameras.readout_s[0]
    assert (np.diag(after.prior_covariance) < np.diag(before.prior_covariance)).all()
    assert (after.coefficients, after.stated) == (before.coefficients, before.stated)


def _model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=6, num_cameras_per_rig=1, num_frames_per_rig=1, num_points3D=60)
    return pycolmap.synthesize_dataset(options)


def _leave(model: pycolmap.Reconstruction, image_id: int, count: int) -> None:
    """Take all but some of an image's observations away."""
    observations = pycolmap.ObservationManager(model)
    seen = [i for i, point in enumerate(model.image(image_id).points2D) if point.has_point3D()]
    for index in seen[count:]:
        if model.image(image_id).point2D(index).has_point3D():
            observations.delete_observation(image_id, index)


def _keypoints(model: pycolmap.Reconstruction) -> list[Array]:
    return [np.array([p.xy for p in model.image(row + 1).points2D]) for row in range(6)]


def _log(model: pycolmap.Reconstruction, settings: SfmSettings | None = None) -> CameraLog:
    """The model's cameras as a phone would log them, and its poses as odometry."""
    cam_T_sfm = np.stack([model.image(row + 1).cam_from_world().matrix() for row in range(6)])
    poses = inverse(make_pose(cam_T_sfm[:, :, :3], cam_T_sfm[:, :, 3]))
    frames = pose_frame("vio_cam", poses).assign(session_id="walk", t_ns=np.arange(6) * 1_000_000_000)
    cameras = [model.camera(row + 1) for row in range(6)]
    focal = [camera.mean_focal_length() for camera in cameras]
    frames = frames.assign(first_row="top", fx=focal, fy=focal, cx=cameras[0].width / 2, cy=cameras[0].height / 2)
    frames = frames.assign(width=cameras[0].width, height=cameras[0].height, distortion=cells([[0.0] * 4] * 6))
    log = frames[["session_id", "t_ns", *pose_frame("vio_cam", poses).columns]]
    return camera_log(frames, {"walk": "phone"}, log, settings or SfmSettings(lens="stated"))
