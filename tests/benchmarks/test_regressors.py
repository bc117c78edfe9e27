from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from known import cells

from benchmarks.regressors import (
    ABLATIONS,
    Training,
    ablation_settings,
    cell,
    earlier,
    errors_and_honesty,
    together,
    write,
)
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


def test_a_case_that_is_not_trained_anew_keeps_its_rows_and_their_revision(tmp_path: Path) -> None:
    def training(revision: str, seed: int = 0) -> Training:
        return Training(seed, revision, {"position mean": 2.0 + seed})

    write(tmp_path, "demo", {"Church": {"PN-Lite": [training("old"), training("old", 1)], "PN": [training("old")]}})
    before = earlier(tmp_path / "regressors.csv")
    results = together(before, {"Church": {"PN-Lite": [training("new")]}, "Office": {"PN": [training("new")]}})
    assert list(results) == ["Church", "Office"] and list(results["Church"]) == ["PN", "PN-Lite"]
    assert results["Church"] == {"PN": [training("old")], "PN-Lite": [training("new")]}
    write(tmp_path, "demo", results)
    assert earlier(tmp_path / "regressors.csv") == results
    assert "| PN | 1 | 2.00 | old |" in (tmp_path / "regressors.md").read_text(encoding="utf-8")
