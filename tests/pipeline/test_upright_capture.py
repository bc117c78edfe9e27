"""A capture whose app saves images turned upright: the sensor's rows are the images' columns."""

import json

import cv2
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import inverse, make_pose
from groundwalk.sfm.definition import STAGE as SFM
from groundwalk.simulation.__main__ import app as simulation_app
from groundwalk.store import DataRoot, execute
from groundwalk.store.tables import poses_of
from tests.known import read_picture, there

pytestmark = pytest.mark.slow
SIMULATED, READOUT_S = "Church", 0.025
CLOCKWISE = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataRoot:
    """A simulated scene, and scenes `auto` and `top` of the same capture with its images turned clockwise."""
    data = DataRoot(tmp_path_factory.mktemp("data"))
    arguments = ["--scene", SIMULATED, "--profile", "tiny", "--data", str(data.root)]
    for setting in (f"readout_s={READOUT_S}", "focus_breathing=0", "width=480", "frame_fraction=0.03"):
        arguments += ["--set", setting]
    CliRunner().invoke(simulation_app, arguments, catch_exceptions=False)
    for recording in find_recordings(data.captures(SIMULATED), data.root / "unpacked", Limits()):
        raw = recording.read(Limits())
        folder = data.captures("auto") / raw.recording_id
        (folder / "images").mkdir(parents=True)
        rows = [{"groundwalk": "frames", "version": 1, "device": raw.device, "clock": raw.clock}]
        for frame in raw.frames:
            row = {"t_ns": frame.t_ns, "vio_T_cam": (there(frame.vio_T_cam) @ inverse(CLOCKWISE)).ravel().tolist()}
            if frame.image is not None:
                image = cv2.rotate(read_picture(frame.image.path), cv2.ROTATE_90_CLOCKWISE)
                height, width = image.shape[:2]
                name, camera = f"images/{frame.number:06d}.png", there(frame.intrinsics)
                cv2.imwrite(str(folder / name), image)
                row |= {"image": name, "width": width, "height": height}
                row |= {"fx": camera.fy, "fy": camera.fx, "cx": width - camera.cy, "cy": camera.cx}
            rows.append(row)
        (folder / "frames.jsonl").write_text("\n".join(map(json.dumps, rows)))
    data.captures("top").symlink_to(data.captures("auto"))
    return data


def reconstructed(data: DataRoot, scene: str, *import_settings: str) -> tuple[pd.Series, str, float]:
    """The lens of the largest model, the side that import took for the first row, and the median position error after a
    similarity fit, metres."""
    folder = execute(IMPORT, scene, "tiny", data, list(import_settings))
    frames = pd.read_parquet(folder / "frames.parquet")
    sfm = execute(SFM, scene, "tiny", data)
    images = pd.read_parquet(sfm / "images.parquet")
    largest = images["model_id"].value_counts().index[0]
    rows = (images["model_id"] == largest).to_numpy()
    truth = pd.read_parquet(data.captures(SIMULATED) / "true_poses.parquet").set_index(["session_id", "t_ns"])
    keys = frames.loc[rows, ["session_id", "t_ns"]].itertuples(index=False, name=None)
    true = poses_of(truth.loc[list(keys)], "map_cam")[:, :3, 3]
    placed = poses_of(images[rows], "sfm_cam")[:, :3, 3]
    error = np.linalg.norm(fit_sim3(true, placed).points(placed) - true, axis=1)
    lens = pd.read_parquet(sfm / "lenses.parquet").set_index("model_id").loc[largest]
    (side,) = frames["first_row"].unique()
    return lens, side, float(np.median(error))


def test_the_readout_follows_the_images_columns_and_a_wrong_axis_is_worse(data: DataRoot) -> None:
    lens, side, error_m = reconstructed(data, "auto")
    wrong, wrong_side, wrong_error_m = reconstructed(data, "top", "first_row='top'")
    print(
        f"readout {1000 * lens['readout_s']:.1f} ± {1000 * lens['readout_sd_s']:.1f} ms, {100 * error_m:.2f} cm; along "
        f"the wrong axis {1000 * wrong['readout_s']:.1f} ms, {100 * wrong_error_m:.2f} cm"
    )
    assert (side, wrong_side) == ("right", "top")
    assert abs(lens["readout_s"] - READOUT_S) < max(3 * lens["readout_sd_s"], 0.002)
    assert error_m < 0.8 * wrong_error_m
    assert abs(wrong["readout_s"]) < 0.5 * READOUT_S
