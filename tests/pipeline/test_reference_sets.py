"""Data sets with reference poses from capture to ground truth: a simulated scene's own ground truth, exported."""

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk.alignment.definition import STAGE as ALIGN
from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.cli import app
from groundwalk.geometry.fits import fit_sim3, pose_residuals
from groundwalk.sfm.definition import STAGE as SFM
from groundwalk.simulation.__main__ import app as simulation_app
from groundwalk.store import DataRoot, execute
from groundwalk.store.tables import poses_of

pytestmark = pytest.mark.slow
SCENE = "Church"


# Two of the formats can't hold a lens: the simulated camera is a pinhole, and is taken as one.
PINHOLE = ["lens=[0, 0, 0]", "readout_s=0", "focus_breathing=0"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataRoot:
    """A simulated scene with ground truth."""
    root = tmp_path_factory.mktemp("data")
    arguments = ["--scene", SCENE, "--profile", "tiny", "--data", str(root)]
    arguments += [part for setting in PINHOLE for part in ("--set", setting)]
    CliRunner().invoke(simulation_app, arguments, catch_exceptions=False)
    execute(IMPORT, SCENE, "tiny", DataRoot(root))
    execute(SFM, SCENE, "tiny", DataRoot(root), ["lens='stated'", "readout_s=0", "refine_cameras='never'"])
    execute(ALIGN, SCENE, "tiny", DataRoot(root))
    return DataRoot(root)


def true_poses(data: DataRoot, scene: str, frames: pd.DataFrame) -> np.ndarray:
    """The simulator's poses (N, 4, 4) of an export's frames, by their images and its frames.csv."""
    listed = pd.read_csv(data.captures(scene) / "frames.csv").set_index("image")["frame_id"]
    simulated = pd.read_parquet(data.run("tiny", SCENE, "import") / "frames.parquet").set_index("frame_id")
    rows = simulated.loc[listed.loc[frames["image"]]]
    truth = pd.read_parquet(data.captures(SCENE) / "true_poses.parquet").set_index(["session_id", "t_ns"])
    return poses_of(truth.loc[list(zip(rows["session_id"], rows["t_ns"], strict=True))], "map_cam")


@pytest.mark.parametrize("name", ["nerfstudio", "colmap", "7scenes", "cambridge"])
def test_an_exported_scene_comes_back(data: DataRoot, name: str) -> None:
    scene = f"{SCENE}-{name}"
    arguments = ["export", "--scene", SCENE, "--profile", "tiny", "--data", str(data.root), "--format", name]
    arguments += ["--images", "copy", "--out", str(data.captures(scene))]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    folder = execute(IMPORT, scene, "tiny", data, ["sampling='all'"])
    frames = pd.read_parquet(folder / "frames.parquet")
    assert len(frames) == 100 and frames["vio_cam_tx"].isna().all()
    execute(SFM, scene, "tiny", data)
    gt = pd.read_parquet(execute(ALIGN, scene, "tiny", data) / "ground_truth.parquet")
    known = (gt["quality"] != "none").to_numpy()
    assert known.mean() >= 0.98
    up = "reference" if name in ("nerfstudio", "colmap") else "reference, up unknown"
    assert set(gt["scale_source"]) == {"reference"} and set(gt["vertical_source"]) == {up}
    # The reference is this scene's ground truth, whose scale and vertical come from simulated VIO.
    found, true = poses_of(gt, "map_cam")[known], true_poses(data, scene, frames)[known]
    true_S_map = fit_sim3(true[:, :3, 3], found[:, :3, 3])
    metres, radians = pose_residuals(true, true_S_map.poses(found), np.eye(4))
    print(
        f"{name}: {known.sum()} frames, {np.median(metres):.4f} m, {np.degrees(np.median(radians)):.3f} deg, "
        f"scale {true_S_map.scale - 1:+.4f}"
    )
    assert np.median(metres) < 0.02 and np.degrees(np.median(radians)) < 0.15
    assert abs(true_S_map.scale - 1) < 0.01
