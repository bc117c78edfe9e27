"""The page of `inspect`: its figures are those of the walk, and its advice follows from them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_page import Look, advice, capture_page, look_at
from groundwalk.cli import app
from groundwalk.geometry.poses import make_pose
from tests.capture_import.capture_writers import WIDTH, Walk, make_walk, write_frames_jsonl

TURN_RAD_S, EXPOSURE_S = 0.5, 0.02


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


def looked_at(folder: Path) -> tuple[list[Look], list[str]]:
    looks: list[Look] = []
    lines = list(
        inspect_capture(
            folder, look=lambda sessions, up, reader: looks.extend(look_at(s, up, reader) for s in sessions)
        )
    )
    return looks, lines


def test_blur_is_that_of_the_turn(tmp_path: Path) -> None:
    turning_walk(tmp_path / "walk", states=True)
    ((look,), lines) = looked_at(tmp_path / "walk")
    focal = np.array([image.camera.fx for image in look.session.images])
    np.testing.assert_allclose(look.blur_px(look.exposures_s), focal * TURN_RAD_S * EXPOSURE_S, rtol=1e-3)
    np.testing.assert_allclose(look.speed_m_s, 1.0, rtol=1e-3)
    page = capture_page("walk", [look], lines)
    assert f"{np.median(focal) * TURN_RAD_S * EXPOSURE_S:.1f} px</b><span>blur length of what is far away" in page


def test_what_is_not_stated_is_said_to_be_unknown_and_the_dark_is_told(tmp_path: Path) -> None:
    turning_walk(tmp_path / "walk", states=False, brightness=0.2)
    looks, lines = looked_at(tmp_path / "walk")
    page = capture_page("walk", looks, lines)
    assert "unknown</b><span>blur length" in page
    told = {what for _, what, _ in advice(looks)}
    assert {"have more light", "come back to where you were, with the same view"} <= told


@pytest.mark.parametrize("kind", ["walk", "photos"])
def test_the_command_writes_one_file_of_any_capture(tmp_path: Path, kind: str) -> None:
    if kind == "walk":
        write_frames_jsonl(tmp_path / "x", make_walk())
    else:
        (tmp_path / "x").mkdir()
        noise = np.random.default_rng(0).integers(0, 255, (4, 72, WIDTH, 3), np.uint8)
        for n, picture in enumerate(noise):
            cv2.imwrite(str(tmp_path / "x" / f"<b>{n}.jpg"), picture)
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, ["inspect", str(tmp_path / "x"), "--html", str(page)])
    assert done.exit_code in (0, 1) and f"look at {page}" in done.output
    html = page.read_text()
    assert "<b>0.jpg" not in html and not re.search(r"(src|href)=.(?!data:|#)", html)
    assert html.count("data:image/jpeg") == (12 if kind == "walk" else 4)
    assert ('class="vio"' in html) == (kind == "walk")


@pytest.mark.parametrize(("unit_m", "status"), [(1.0, 0), (1e-3, 1)])
def test_the_exit_status_says_whether_a_capture_can_be_used(tmp_path: Path, unit_m: float, status: int) -> None:
    walk = make_walk()
    poses = make_pose(walk.vio_T_cam[:, :3, :3], walk.vio_T_cam[:, :3, 3] / unit_m)
    write_frames_jsonl(tmp_path / "walk", replace(walk, vio_T_cam=poses))
    assert CliRunner().invoke(app, ["inspect", str(tmp_path / "walk")]).exit_code == status


def test_a_page_that_cannot_be_written_is_refused_first(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["inspect", str(tmp_path), "--html", str(tmp_path / "no" / "page.html")])
    assert done.exit_code != 0 and "can't be written there" in str(done.exception) + done.output
