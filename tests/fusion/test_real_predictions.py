"""Published predictions read as walks."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.real_predictions import real_cases
from groundwalk.geometry.poses import Array, heading, make_pose, relative, yaw_rotation
from groundwalk.scoring.errors import position_error


def written(folder: Path, frames: int = 12) -> tuple[Array, Path]:
    """Two sequences in the files' conventions, up not being y, predicted 0.5 m off; the true poses in ours."""
    level = yaw_rotation(0.1 * np.arange(frames)) @ np.diag([1.0, -1.0, -1.0])
    truth = make_pose(level, np.column_stack([np.arange(frames), np.zeros((frames, 2))]))
    map_R_ours = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    opengl = make_pose(map_R_ours, np.zeros(3)) @ truth @ np.diag([1.0, -1.0, -1.0, 1.0])
    place = folder / "PoseNet" / "Cambridge"
    place.mkdir(parents=True)
    for name, shift in (("predict", [0.5, 0, 0]), ("test_gt", [0, 0, 0])):
        lines = []
        for i, pose in enumerate(opengl):
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            numbers = [*(pose[:3, 3] + shift), w, x, y, z]
            lines.append(f"seq{i % 2}/frame{i // 2:05d}.png " + " ".join(map(str, numbers)))
        (place / f"Hall_{name}.txt").write_text("\n".join(lines))
    return truth, place


def test_walks_are_upright_and_in_this_projects_conventions(tmp_path: Path) -> None:
    truth, _ = written(tmp_path)
    (case,) = real_cases(tmp_path, ["Hall"], [0, 1])
    assert (case.scene, case.model, len(case.walks)) == ("Hall", "PoseNet", 4)
    walk = case.walks[0]
    own = truth[::2]
    assert np.allclose(relative(walk.map_T_cam[0], walk.map_T_cam[3]), relative(own[0], own[3]), atol=1e-9)
    assert np.allclose(walk.map_T_cam[:, 1, :3], own[:, 1, :3], atol=1e-9)
    assert np.allclose(position_error(walk.map_T_cam_predicted, walk.map_T_cam), 0.5)
    assert not np.array_equal(walk.vio_T_cam, case.walks[2].vio_T_cam)
    turned = heading(walk.map_T_cam[:, :3, :3] @ walk.vio_T_cam[:, :3, :3].transpose(0, 2, 1))
    assert np.ptp(turned) < np.radians(10)
