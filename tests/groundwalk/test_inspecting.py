"""What `inspect` advises for the next walk follows from the capture; its exit status says whether it can be used."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from groundwalk.cli import app
from groundwalk.geometry.poses import make_pose
from tests.capture_import.capture_writers import WIDTH, Walk, make_walk, write_frames_jsonl

TURN_RAD_S, EXPOSURE_S = 0.5, 0.1


def turning_walk(folder: Path, states: bool, brightness: float = 1.0) -> None:
    """A walk that turns about its vertical at one rate; `states`: the exposure is in the log."""
    walk, t_s = make_walk(), np.arange(24) / 10
    poses = [
        make_pose(Rotation.from_rotvec([0, TURN_RAD_S * t, 0]).as_matrix() @ np.diag([1, -1, -1]), [t, 0, 0])
        for t in t_s
    ]
    pictures = np.array([(walk.picture(i) * brightness).astype(np.uint8) for i in range(24)])
    write_frames_jsonl(folder, Walk(walk.t_ns, np.array(poses), walk.camera, walk.has_image, pictures))
    if states:
        header, *rows = (json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines())
        rows = [row | {"exposure_s": EXPOSURE_S} for row in rows]
        lines = [json.dumps(row) for row in [header, *rows]]
        (folder / "frames.jsonl").write_text("\n".join(lines))


def inspected(folder: Path, status: int = 0) -> str:
    """What is advised."""
    done = CliRunner().invoke(app, ["inspect", str(folder)])
    assert done.exit_code == status, done.output
    return done.output.partition("in the next walk")[2]


def test_blur_is_that_of_the_turn(tmp_path: Path) -> None:
    turning_walk(tmp_path / "walk", states=True)
    blur_px = make_walk().camera[0, 0] * TURN_RAD_S * EXPOSURE_S
    said = inspected(tmp_path / "walk")
    assert (
        f"turn more slowly, or have more light (in a tenth of images what is far away blurs by {blur_px:.0f} px" in said
    )
    assert "walk more slowly" not in said and "have more light (brightness" not in said


def test_the_dark_and_a_walk_without_a_loop_are_told(tmp_path: Path) -> None:
    turning_walk(tmp_path / "walk", states=False, brightness=0.2)
    said = inspected(tmp_path / "walk")
    assert "have more light (brightness" in said and "come back to where you were, with the same view" in said
    assert "blurs" not in said and "record a second walk over the same ground" in said


def test_photos_need_poses(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (4, 72, WIDTH, 3), np.uint8)
    for n, picture in enumerate(noise):
        cv2.imwrite(str(tmp_path / f"{n}.jpg"), picture)
    said = inspected(tmp_path)
    assert "record with an app that logs poses" in said and "4 images; 60 or more" in said


@pytest.mark.parametrize(("unit_m", "status"), [(1.0, 0), (1e-3, 1)])
def test_the_exit_status_says_whether_a_capture_can_be_used(tmp_path: Path, unit_m: float, status: int) -> None:
    walk = make_walk()
    poses = make_pose(walk.vio_T_cam[:, :3, :3], walk.vio_T_cam[:, :3, 3] / unit_m)
    write_frames_jsonl(tmp_path / "walk", replace(walk, vio_T_cam=poses))
    inspected(tmp_path / "walk", status)
