"""COLMAP's ways of mapping, with our options."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.lens import rational_of_fisheye
from groundwalk.sfm.database import image_id, pose_of
from groundwalk.sfm.mapping.mappers import from_poses, incremental_mapping
from groundwalk.sfm.plugins import MappingInput


def test_where_no_first_pair_is_so_exact_mapping_begins_within_colmaps_own_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, limits = MappingInput(tmp_path / "database.db", tmp_path, 0), []
    with pycolmap.Database.open(given.database) as database:
        database.write_camera(pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[300, 300, 1, 1]))

    def no_model(*arguments: Any, **_: Any) -> dict[int, pycolmap.Reconstruction]:
        limits.append(arguments[3].mapper.init_max_error)
        return {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", no_model)
    assert incremental_mapping(given, tmp_path, lambda: None) == [] and limits == [1.0, 4.0]


def test_poses_that_are_centimetres_off_are_a_start_that_images_correct(tmp_path: Path) -> None:
    given, true = synthetic(tmp_path, 8)
    true_T_cam = np.stack([pose_of(true.image(image_id(row))) for row in range(8)])
    start_T_cam = true_T_cam.copy()
    start_T_cam[:, :3, 3] += np.random.default_rng(0).normal(0, 0.03, (8, 3))
    start_T_cam[7] = np.nan
    model = from_poses(given, start_T_cam, tmp_path)
    assert model.num_reg_images() == 7 and model.compute_mean_reprojection_error() < 0.1
    found_T_cam = np.stack([pose_of(model.image(image_id(row))) for row in range(7)])
    fit = fit_sim3(true_T_cam[:7, :3, 3], found_T_cam[:, :3, 3])
    assert np.abs(fit.points(found_T_cam[:, :3, 3]) - true_T_cam[:7, :3, 3]).max() < 1e-3


def test_a_fisheye_lens_is_mapped(tmp_path: Path) -> None:
    given, _ = synthetic(
        tmp_path,
        12,
        camera_width=640,
        camera_height=480,
        camera_model_id=pycolmap.CameraModelId.FULL_OPENCV,
        camera_has_prior_focal_length=True,
        camera_params=[320, 320, 320, 240, *rational_of_fisheye([-0.03, 0.01, -0.005, 0.001], 1.05, 5e-5)],
    )
    (model,) = incremental_mapping(given, tmp_path, lambda: None)
    assert model.num_reg_images() == 12 and model.compute_mean_reprojection_error() < 0.5


def synthetic(folder: Path, frames: int, **options: Any) -> tuple[MappingInput, pycolmap.Reconstruction]:
    """A database of so many frames of COLMAP's synthetic scene, and the true model."""
    counts: dict[str, Any] = {"num_rigs": 1, "num_frames_per_rig": frames, "num_points3D": 300}
    given = MappingInput(folder / "database.db", folder, 0)
    with pycolmap.Database.open(given.database) as database:
        return given, pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**counts, **options), database)
