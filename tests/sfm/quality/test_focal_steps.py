"""Steps of focal lengths within a session, as adjusted; the logged ones are constant."""

from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import make_pose
from groundwalk.sfm.pairs.odometry import odometry
from groundwalk.sfm.quality.focal_steps import FocalStep, focal_step, with_focal_steps
from groundwalk.sfm.quality.zoom import zoom_of_session

_LIMIT, _F = 0.03, 500.0


def _noise(count: int, seed: int = 0) -> np.ndarray:
    return np.exp(np.random.default_rng(seed).normal(0, 0.0015, count))


@pytest.mark.parametrize(("first", "factor"), [(12, 1.25), (3, 1.05), (21, 0.5)])
def test_a_zoom_is_found_at_its_frame(first: int, factor: float) -> None:
    scale = _noise(24)
    scale[first:] *= factor
    step = focal_step(scale, _LIMIT)
    assert step is not None and step.first == first
    assert step.factor == pytest.approx(factor, rel=0.01)


def test_a_zoom_that_is_taken_back_is_found() -> None:
    scale = _noise(30)
    scale[10:16] *= 1.25
    step = focal_step(scale, _LIMIT)
    assert step is not None and step.first in (10, 16)


@pytest.mark.parametrize("shape", ["noise", "breathing", "drift", "one frame", "short"])
def test_what_is_no_zoom_is_no_step(shape: str) -> None:
    scale = _noise(4 if shape == "short" else 60)
    if shape == "breathing":
        scale *= 1 + 0.02 * np.sin(np.linspace(0, 6 * np.pi, 60))
    elif shape == "drift":
        scale *= np.linspace(1, 1.4, 60)
    elif shape == "one frame":
        scale[30] *= 1.25
    assert focal_step(scale, _LIMIT) is None


def test_each_session_of_a_model_is_looked_at_in_the_order_of_time() -> None:
    sessions = np.repeat(["a", "b"], 12)
    frames = pd.DataFrame({"session_id": sessions, "t_ns": np.tile(np.arange(12), 2), "fx": 500.0})
    frames["frame_id"] = [f"{s}/{t:06d}" for s, t in zip(sessions, frames["t_ns"], strict=True)]
    images = pd.DataFrame({"model_id": "incremental/0", "fx": 500 * _noise(24)})
    images.loc[18:, "fx"] *= 1.2
    shuffled = np.random.default_rng(1).permutation(24)
    frames, images = (table.iloc[shuffled].reset_index(drop=True) for table in (frames, images))
    intrinsics = pd.DataFrame({"model_id": "incremental/0", "session_id": ["a", "b"]})
    found = with_focal_steps(intrinsics, frames, images, _LIMIT, {})
    assert found["focal_step_frame_id"].tolist() == [None, "b/000006"]
    assert np.isnan(found["focal_step"][0]) and found["focal_step"][1] == pytest.approx(1.2, rel=0.01)
    # A zoom that pairs show, which bends the model.
    found = with_focal_steps(intrinsics, frames, images, _LIMIT, {"a": FocalStep(7, 1.3)})
    assert found["focal_step_frame_id"].tolist() == [frames["frame_id"][7], "b/000006"]
    assert found["focal_step"][0] == 1.3


@pytest.mark.parametrize("factor", [1.0, 1.15, 0.7])
def test_a_zoom_is_found_by_neighbours_and_vio(factor: float, tmp_path: Path) -> None:
    rng, count = np.random.default_rng(0), 28
    points = rng.uniform([-6, -3, 4], [6, 3, 14], (200, 3))
    turns = Rotation.from_rotvec(np.radians(6) * np.sin(np.arange(count))[:, None] * [0.3, 1.0, 0.0])
    walk_T_cam = make_pose(turns.as_matrix(), np.outer(0.4 * np.arange(count), [1.0, 0.0, 0.2]) - [5.6, 0, 3])
    drifted = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(count, 3)).cumsum(axis=0))
    vio_T_cam = walk_T_cam.copy()
    vio_T_cam[:, :3, :3] = drifted.as_matrix() @ walk_T_cam[:, :3, :3]
    database = tmp_path / "zoom.db"
    with pycolmap.Database.open(database) as opened:
        keypoints = []
        for row in range(count):
            camera = pycolmap.Camera(
                camera_id=row + 1, model="PINHOLE", width=640, height=480, params=[_F, _F, 320, 240]
            )
            opened.write_camera(camera, use_camera_id=True)
            opened.write_image(pycolmap.Image(name=f"{row}", camera_id=row + 1, image_id=row + 1), use_image_id=True)
            in_cam = (points - walk_T_cam[row, :3, 3]) @ walk_T_cam[row, :3, :3]
            zoomed = _F * (factor if row >= 15 else 1.0)
            keypoints.append(zoomed * in_cam[:, :2] / in_cam[:, 2:] + [320, 240] + rng.normal(0, 0.3, (200, 2)))
            opened.write_keypoints(row + 1, keypoints[-1].astype(np.float32))
        for row in range(count - 1):
            seen = [np.all((k > 0) & (k < [640, 480]), axis=1) for k in keypoints[row : row + 2]]
            both = np.flatnonzero(seen[0] & seen[1])
            pair = pycolmap.TwoViewGeometry(config=2, inlier_matches=np.stack([both, both], axis=1).astype(np.uint32))
            opened.write_two_view_geometry(row + 1, row + 2, pair)
    vio = odometry(np.full(count, "a", object), np.arange(count), vio_T_cam, np.full((count, 3), np.nan), [])
    zoom = zoom_of_session(database, np.arange(count), vio, _LIMIT)
    if factor == 1.0:
        assert zoom is None
    else:
        assert zoom is not None and abs(zoom.first - 15) <= 2
        assert zoom.factor == pytest.approx(factor, rel=0.03)
