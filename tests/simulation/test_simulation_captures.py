"""Captures as they land on disk: format, truth, determinism, resuming, and respect for what others wrote."""

import hashlib
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from artefacts import DataRoot, UserError
from artefacts.schemas import schema
from artefacts.tables import poses_of, read_table
from geometry.poses import ARKIT_CAM_T_CAM, relative, rotation_angle
from simulation import simulate as module
from simulation.simulate import simulate

SCENE = "Office"
SMALL = [
    "frame_share=0.006",
    "test_frames=600",
    "train_sessions=2",
    "test_sessions=1",
    "rate_hz=5",
    "width=96",
    "height=72",
    "texel_m=0.12",
]


def run(root: Path, **more: object) -> Path:
    return simulate(SCENE, "tiny", DataRoot(root), SMALL, processes=int(str(more.pop("processes", 1))), **more)  # type: ignore[arg-type]


def digests(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("data"))


def test_frames_have_the_apps_fields(finished: Path, shared_captures: Path) -> None:
    real = json.loads(next((shared_captures / "chair").glob("*/frame_00000.json")).read_text())
    real_info = json.loads(next((shared_captures / "chair").glob("*/info.json")).read_text())
    session = finished / "train-1"
    mine = json.loads((session / "frame_00000.json").read_text())
    assert mine.keys() == real.keys()
    for key, value in real.items():
        assert isinstance(mine[key], (type(value), float))
        if isinstance(value, list):
            assert len(mine[key]) == len(value)
    assert json.loads((session / "info.json").read_text()).keys() >= real_info.keys()


def test_json_and_truth_describe_the_same_motion(finished: Path) -> None:
    truth = read_table(finished / "true_poses.parquet", schema("simulate", "true_poses"))
    for session in ("train-1", "train-2", "test-1"):
        rows = truth[truth.session_id == session]
        frames = [json.loads(p.read_text()) for p in sorted((finished / session).glob("frame_*.json"))]
        assert [round(f["time"] * 1e9) for f in frames] == rows.t_ns.tolist()
        assert [f["frame_index"] for f in frames] == list(range(len(rows)))
        world_T_cam = poses_of(rows, "map_cam")
        vio_T_cam = np.array([f["cameraPoseARFrame"] for f in frames]).reshape(-1, 4, 4) @ ARKIT_CAM_T_CAM
        seen, true = (relative(p[:-1], p[1:]) for p in (vio_T_cam, world_T_cam))
        assert np.median(np.linalg.norm(seen[:, :3, 3] - true[:, :3, 3], axis=1)) < 0.02
        assert np.median(np.degrees(rotation_angle((relative(seen, true))[:, :3, :3]))) < 0.5
        k = np.array([f["intrinsics"] for f in frames]).reshape(-1, 3, 3)
        assert np.abs(k[:, 0, 0] / (1447.65 / 1920 * 96) - 1).max() < 0.01
        assert np.ptp(k[:, 0, 0]) > 0


def test_pictures_go_with_every_kth_pose(finished: Path) -> None:
    marker = json.loads((finished / "SIMULATED.json").read_text())
    for name, count in marker["sessions"].items():
        indices = [int(p.stem[-5:]) for p in sorted((finished / name).glob("*.jpg"))]
        assert indices == list(range(0, count["poses"], 5))
        assert len(indices) == count["images"]
        image = cv2.imread(str(finished / name / "frame_00000.jpg"))
        assert image.shape == (72, 96, 3)
        assert 40 < image.mean() < 220
        assert image.std() > 10
    assert marker["reduced"]["image size"] == {"here": "96x72", "paper": "1920x1440"}


def test_number_of_processes_changes_no_byte(finished: Path, tmp_path: Path) -> None:
    assert digests(run(tmp_path, processes=2)) == digests(finished)


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
    with pytest.raises(UserError, match="didn't write"):
        run(tmp_path, force=force)
    assert foreign.read_text() == "{}"


def test_a_foreign_file_among_simulated_ones_stops_a_new_simulation(finished: Path, tmp_path: Path) -> None:
    copy = tmp_path / "captures" / SCENE
    copy.parent.mkdir()
    os.system(f"cp -r '{finished}' '{copy}'")
    (copy / "train-1" / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match=r"(?s)didn't write.*notes\.txt"):
        run(tmp_path, force=True)
    assert (copy / "train-1" / "notes.txt").is_file()


def test_an_unknown_scene_is_named_with_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"(?s)Nowhere.*Church"):
        simulate("Nowhere", "tiny", DataRoot(tmp_path))
