import numpy as np
import pandas as pd
import pytest
from known import cells

from benchmarks.regressors import ABLATIONS, ablation_settings, cell, errors_and_honesty
from groundwalk.artefacts.tables import pose_frame
from groundwalk.geometry.poses import make_pose, yaw_rotation


def test_figures_of_answers() -> None:
    count = 40
    names = [f"walk/{i:06d}" for i in range(count)]
    sd = np.linspace(0.1, 1, count)
    off = np.random.default_rng(0).normal(size=(count, 3)) * sd[:, None]
    true_poses = pose_frame("map_cam", np.tile(np.eye(4), (count, 1, 1)))
    truth = pd.concat([pd.DataFrame({"frame_id": names}), true_poses], axis=1)
    estimated = make_pose(yaw_rotation(np.radians(10 * sd)), off)
    covariance = cells(np.diag([1.0] * 3 + [s * s] * 3).ravel().tolist() for s in sd)
    answers = pd.concat([pd.DataFrame({"frame_id": names, "split": "test"}), pose_frame("map_cam", estimated)], axis=1)
    figures = errors_and_honesty(answers.assign(covariance=covariance), truth)
    assert figures["position median"] == pytest.approx(np.median(np.linalg.norm(off, axis=1)))
    assert figures["rotation mean"] == pytest.approx(10 * sd.mean())
    assert 85 <= figures["position in bounds"] <= 100 and figures["rotation in bounds"] == 100
    assert figures["position rank correlation"] > 0.5
    assert "position in bounds" not in errors_and_honesty(answers.assign(covariance=None), truth)


def test_settings_and_cells() -> None:
    assert ablation_settings(["upright=false", "undistort=false"]) == [
        "regressors.PN-Lite.upright=false",
        "undistort=false",
    ]
    assert all(ABLATIONS.values())
    assert cell(np.array([1.0, 2.0])) == "1.50 (1.00 to 2.00)" and cell(np.array([])) == "-"
