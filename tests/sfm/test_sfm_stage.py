"""The whole stage on a tiny room with two walks and known poses."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest
from conftest import Room

from artefacts import UserError, execute
from artefacts.tables import poses_of
from geometry.fits import fit_sim3
from geometry.poses import rotation_angle
from sfm.stage import STAGE

_SETTINGS = ["sequence_pairs=3", "vio_pairs=2", "retrieval_pairs=3", "retrieval_words=16"]
_TABLES = ["images", "models", "pairs", "points"]


def _run(room: Room, *settings: str) -> Path:
    return execute(STAGE, "room", "tiny", room.data, [*_SETTINGS, *settings])


def test_a_room_of_two_walks_becomes_one_right_model(room: Room) -> None:
    folder = _run(room)
    images = pd.read_parquet(folder / "images.parquet")
    assert images["registered"].all()
    sfm_T_cam = poses_of(images, "sfm_cam")
    fit = fit_sim3(room.true_T_cam[:, :3, 3], sfm_T_cam[:, :3, 3])
    placed = fit.poses(sfm_T_cam)
    assert np.linalg.norm(placed[:, :3, 3] - room.true_T_cam[:, :3, 3], axis=1).max() < 0.02
    turned = rotation_angle(np.swapaxes(placed[:, :3, :3], 1, 2) @ room.true_T_cam[:, :3, :3])
    assert np.degrees(turned).max() < 0.3
    covariance = np.array(list(images["covariance"])).reshape(-1, 6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()

    pairs = pd.read_parquet(folder / "pairs.parquet")
    assert {"sequence", "retrieval"} <= set(pairs["origin"])
    across = pairs["frame_id_a"].str.split("/").str[0] != pairs["frame_id_b"].str.split("/").str[0]
    assert (pairs.loc[across, "verdict"] == "verified").any()
    assert not pairs.duplicated(["frame_id_a", "frame_id_b"]).any()

    # The model beside the tables is COLMAP's own, with the captured intrinsics as they were.
    model = pycolmap.Reconstruction(folder / "model")
    points = pd.read_parquet(folder / "points.parquet")
    assert model.num_points3D() == len(points)
    assert model.compute_num_observations() == images["observations"].sum() == points["track_length"].sum()
    assert images["reprojection_px"].mean() == pytest.approx(model.compute_mean_reprojection_error(), rel=0.2)
    assert {image.name for image in model.images.values()} == {f"{i}.jpg" for i in images["frame_id"]}
    assert all(list(camera.params) == [260, 260, 160, 120] for camera in model.cameras.values())
    assert not (folder / "scratch").exists()


@pytest.mark.slow
def test_a_stage_killed_anywhere_ends_in_the_same_tables(room: Room, tmp_path: Path) -> None:
    scratch = room.data.run("tiny", "room", ".sfm.partial") / "scratch"
    program = tmp_path / "run.py"
    program.write_text(
        "from pathlib import Path\nfrom artefacts import DataRoot, execute\nfrom sfm.stage import STAGE\n"
        f"if __name__ == '__main__':\n"
        f"    execute(STAGE, 'room', 'tiny', DataRoot(Path({str(room.data.root)!r})), {_SETTINGS})\n"
    )
    for reached in (scratch / "database.db", scratch / "pairs.txt", scratch / "mapping"):
        process = subprocess.Popen([sys.executable, program], start_new_session=True)
        while not reached.exists() and process.poll() is None:
            time.sleep(0.005)
        assert process.poll() is None, "it ended before it could be killed"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    resumed = {table: (_run(room) / f"{table}.parquet").read_bytes() for table in _TABLES}
    at_once = execute(STAGE, "room", "tiny", room.data, _SETTINGS, force=True)
    for table in _TABLES:
        assert (at_once / f"{table}.parquet").read_bytes() == resumed[table], table


def test_images_without_texture_end_in_a_clear_error(room: Room) -> None:
    for image in room.frames["image"]:
        path = room.data.captures("room") / image
        path.write_bytes(_grey_jpeg())
    with pytest.raises(UserError, match="hardly any features"):
        _run(room)


def test_a_model_of_too_few_frames_is_refused_with_figures(room: Room) -> None:
    for image in room.frames["image"][3:]:
        (room.data.captures("room") / image).write_bytes(_grey_jpeg())
    with pytest.raises(UserError) as caught:
        _run(room, "min_registered=0.9")
    assert "14 frames" in str(caught.value)
    assert "verified" in str(caught.value)


def test_a_frame_without_its_image_is_named(room: Room) -> None:
    (room.data.captures("room") / room.frames["image"][4]).unlink()
    with pytest.raises(UserError, match="one/000004"):
        _run(room)


def _grey_jpeg() -> bytes:
    return cv2.imencode(".jpg", np.full((240, 320), 128, np.uint8))[1].tobytes()
