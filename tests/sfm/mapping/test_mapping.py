from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.linalg import LinAlgError

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.model_adjustment import adjust_model
from groundwalk.sfm.mapping.built import BuiltModel
from groundwalk.sfm.model import load_models
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.tables import camera_tables
from groundwalk.store.choices import CameraOrigin
from tests.sfm.synthetic_model import log_of, synthetic_model


def test_points_behind_a_camera_are_taken_out(tmp_path: Path) -> None:
    model = synthetic_model()
    behind, image_id = next((p, t.image_id) for p, point in model.points3D.items() for t in point.track.elements)
    centre = model.image(image_id).projection_center()
    model.point3D(behind).xyz = 2 * centre - model.point3D(behind).xyz

    model.write_binary(tmp_path)
    adjusted, rows = adjust_model(model, _keypoints(model), log_of(model), SfmSettings(refine_cameras="never"))

    model.write_binary(tmp_path)
    left = load_models([tmp_path], 6)
    assert rows.tolist() == list(range(6)) and np.isfinite(adjusted.loss_px)
    assert np.isfinite(left.residual_px).all() and np.isfinite(left.point_error_px()).all()
    assert left.registered.all() and len(left.xyz) >= 59


def test_a_frame_with_hardly_an_observation_is_deregistered() -> None:
    model = synthetic_model()
    _leave(model, 6, 5)
    adjusted, rows = adjust_model(model, _keypoints(model), log_of(model), SfmSettings())
    assert rows.tolist() == list(range(5)) == [frame_id - 1 for frame_id in sorted(model.reg_frame_ids())]
    assert len(adjusted.bundle.sfm_T_cam) == 5 and np.isfinite(adjusted.bundle.sfm_T_cam).all()


def test_a_model_of_a_handful_of_observations_is_not_determined() -> None:
    model = synthetic_model()
    for image_id in range(1, 7):
        _leave(model, image_id, 5)
    with pytest.raises(LinAlgError, match="hardly any frame"):
        adjust_model(model, _keypoints(model), log_of(model), SfmSettings())


def test_cameras_of_a_model_without_covariances_have_no_sigma() -> None:
    model = synthetic_model()
    log = log_of(model)
    adjusted = adjust_model(model, _keypoints(model), log, SfmSettings())
    lenses, sessions = camera_tables(
        log, [CameraOrigin.STATED] * 6, [BuiltModel.of("incremental", 0, model)], [adjusted], [None]
    )
    assert lenses[["k1_sd", "k2_sd", "k3_sd", "readout_sd_s"]].isna().all(axis=None)
    assert sessions["focal_scale_sd"].isna().all() and sessions["session_id"].tolist() == ["walk"]
    assert lenses["frames"].tolist() == sessions["frames"].tolist() == [6]


def _leave(model: pycolmap.Reconstruction, image_id: int, count: int) -> None:
    """Take all but some of an image's observations away."""
    observations = pycolmap.ObservationManager(model)
    seen = [i for i, point in enumerate(model.image(image_id).points2D) if point.has_point3D()]
    for index in seen[count:]:
        if model.image(image_id).point2D(index).has_point3D():
            observations.delete_observation(image_id, index)


def _keypoints(model: pycolmap.Reconstruction) -> list[Array]:
    return [np.array([p.xy for p in model.image(row + 1).points2D]) for row in range(6)]
