"""Captures as they land on disk: format, truth, determinism, resuming, and respect for what others wrote."""

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, relative, rotation_angle
from groundwalk.simulation import simulate as module
from groundwalk.simulation.simulate import simulate
from groundwalk.store import DataRoot, UserError
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table
from tests.known import read_picture

SCENE = "Office"
SMALL = [
    "frame_fraction=0.006",
    "test_frames=600",
    "train_sessions=2",
    "test_sessions=1",
    "rate_hz=5",
    "width=96",
    "texel_m=0.12",
]


PINHOLE = ["lens=[0, 0, 0]", "readout_s=0", "focus_breathing=0"]
PHONE = ["lens=[0.09, -0.11, 0.2]", "focus_breathing=0.005"]


def run(root: Path, settings: Sequence[str] = PINHOLE, **more: Any) -> Path:
    chosen = [*SMALL, *settings]
    return simulate(SCENE, "tiny", DataRoot(root), chosen, **{"processes": 1, **more})


def digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pinhole's capture."""
    return run(tmp_path_factory.mktemp("data"))


def test_frames_have_the_apps_fields(finished: Path, shared_captures: Path) -> None:
    real = json.loads(next((shared_captures / "chair").glob("*/frame_00000.json")).read_text())
    mine = json.loads((finished / "train-1" / "frame_00000.json").read_text())
    for key, value in mine.items():
        assert isinstance(value, (type(real[key]), float))
        if isinstance(value, list):
            assert len(value) == len(real[key])


def test_json_and_truth_describe_the_same_motion(finished: Path) -> None:
    truth = read_table(finished / "true_poses.parquet", schema("simulate", "true_poses"))
    for session in ("train-1", "train-2", "test-1"):
        rows = truth[truth.session_id == session]
        frames = [json.loads(p.read_text()) for p in sorted((finished / session).glob("frame_*.json"))]
        assert [round(f["time"] * 1e9) for f in frames] == rows.t_ns.tolist()
        world_T_cam = poses_of(rows, "map_cam")
        vio_T_cam = np.array([f["cameraPoseARFrame"] for f in frames]).reshape(-1, 4, 4) @ ARKIT_CAM_T_CAM
        seen, true = (relative(p[:-1], p[1:]) for p in (vio_T_cam, world_T_cam))
        assert np.median(np.linalg.norm(seen[:, :3, 3] - true[:, :3, 3], axis=1)) < 0.02
        assert np.median(np.degrees(rotation_angle((relative(seen, true))[:, :3, :3]))) < 0.5
        k = np.array([f["intrinsics"] for f in frames]).reshape(-1, 3, 3)
        assert np.abs(k[:, 0, 0] / (1447.65 / 1920 * 96) - 1).max() < 0.01
        assert np.ptp(k[:, 0, 0]) > 0


def test_a_phones_camera_is_in_the_truth_and_in_the_pictures_but_not_in_the_json(
    finished: Path, tmp_path: Path
) -> None:
    folder = run(tmp_path / "once", PHONE)
    cameras = read_table(folder / "true_cameras.parquet", schema("simulate", "true_cameras"))
    poses = read_table(folder / "true_poses.parquet", schema("simulate", "true_poses"))
    assert cameras[["session_id", "t_ns"]].equals(poses[["session_id", "t_ns"]])
    # One phone walks all sessions.
    assert cameras[["k1", "k2", "k3", "readout_s", "time_offset_s"]].drop_duplicates().shape == (1, 5)
    assert (cameras[["k1", "k2", "k3"]] == [0.09, -0.11, 0.2]).all(axis=None)
    assert 0.010 <= cameras.readout_s[0] <= 0.030
    logs = sorted(p.relative_to(folder) for p in folder.rglob("*.json") if p.name != "SIMULATED.json")
    assert [p for p in logs if (folder / p).read_bytes() != (finished / p).read_bytes()] == []
    logged = np.array([json.loads((folder / p).read_text())["intrinsics"][0] for p in logs if p.name != "info.json"])
    order = cameras.sort_values(["session_id", "t_ns"])
    assert 0.001 < np.abs(order.fx / logged - 1).max() <= 0.00501
    pictures = sorted(p.relative_to(folder) for p in folder.rglob("*.jpg"))
    assert all((folder / p).read_bytes() != (finished / p).read_bytes() for p in pictures)
    assert digests(run(tmp_path / "again", PHONE, processes=2)) == digests(folder)


@pytest.mark.parametrize("setting", ["lens=[0.1, 2, 0]", "readout_s=20", "focus_breathing=null"])
def test_a_camera_setting_out_of_range_is_named(tmp_path: Path, setting: str) -> None:
    with pytest.raises(UserError, match=f'{setting.partition("=")[0]}.*number.* or "drawn"'):
        run(tmp_path, [setting])


def test_pictures_go_with_every_kth_pose(finished: Path) -> None:
    marker = json.loads((finished / "SIMULATED.json").read_text())
    for name, count in marker["sessions"].items():
        indices = [int(p.stem[-5:]) for p in sorted((finished / name).glob("*.jpg"))]
        assert indices == list(range(0, count["poses"], 5))
        assert len(indices) == count["images"]
        image = read_picture(finished / name / "frame_00000.jpg")
        assert image.shape == (72, 96, 3)
        assert 40 < image.mean() < 220
        assert image.std() > 10


def test_a_killed_run_leaves_nothing_finished_and_goes_on(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def dies(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(module, "write_truth", dies)
    with pytest.raises(Killed):
        run(tmp_path)
    assert not (tmp_path / "captures" / SCENE).exists()
    partial = tmp_path / "captures" / f".{SCENE}.partial"
    pictures = sorted(partial.rglob("*.jpg"))
    assert pictures
    pictures[0].unlink()
    kept = {p: p.stat().st_mtime_ns for p in pictures[1:]}
    monkeypatch.undo()
    assert digests(run(tmp_path)) == digests(finished)
    assert {p: (tmp_path / "captures" / SCENE / p.relative_to(partial)).stat().st_mtime_ns for p in kept} == kept
    assert not partial.exists()


def test_a_finished_capture_is_left_as_it_is(finished: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in finished.rglob("*.j*") if p.name != "SIMULATED.json"}
    run(finished.parents[1])
    assert {p: p.stat().st_mtime_ns for p in before} == before


@pytest.mark.parametrize("force", [False, True])
def test_captures_of_others_are_never_touched(tmp_path: Path, force: bool) -> None:
    foreign = tmp_path / "captures" / SCENE / "walk" / "frame_00000.json"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("{}")
    with pytest.raises(UserError, match="aren't simulated"):
        run(tmp_path, force=force)
    assert foreign.read_text() == "{}"


def test_a_walk_that_comes_while_captures_are_simulated_anew_stays(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "captures" / SCENE
    shutil.copytree(finished, copy)
    render = module.render_images

    def add_a_walk(*arguments: Any) -> None:
        (copy / "mine").mkdir()
        (copy / "mine" / "frame_00000.json").write_text("{}")
        render(*arguments)

    monkeypatch.setattr(module, "render_images", add_a_walk)
    run(tmp_path, force=True)
    assert (copy / "mine" / "frame_00000.json").is_file() and not copy.with_name(f".{SCENE}.old").exists()
    (copy.with_name("elsewhere")).mkdir()
    copy.rename(copy.with_name("elsewhere") / "captures")
    copy.symlink_to(copy.with_name("elsewhere") / "captures")
    with pytest.raises(UserError, match=r"found: +a link"):
        run(tmp_path, force=True)
