"""Recordings added to a finished ground truth, and taken out of it, by the commands."""

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk import adding
from groundwalk.geometry.fits import fit_yaw
from groundwalk.geometry.poses import rotation_angle
from groundwalk.pipeline import is_step_up_to_date, steps
from groundwalk.store import DataRoot, UserError, execute, stage
from groundwalk.store.errors import MachineError
from groundwalk.store.files import hash_files
from groundwalk.store.inputs import capture_files
from groundwalk.store.tables import poses_of
from tests.known import put, written
from tests.sfm.textured_room import make_recording

_STAGES = ("import", "sfm", "align")
_WALKS = {"one": (1.5, 2.6), "two": (1.2, 2.2), "three": (1.35, 2.4)}
_CONFIG = """
[import]
sampling = "all"
check_convention = false
[sfm]
sequence_pairs = 3
vio_pairs = 2
retrieval_pairs = 3
"""
_FRAMES = 10


class _Killed(BaseException):
    pass


def _build(data: DataRoot) -> None:
    for name in _STAGES:
        execute(adding.stage_of(name), "room", "tiny", data)


def _command(data: DataRoot, *arguments: str) -> str:
    more = ["--scene", "room", "--profile", "tiny", "--data", str(data.root)]
    return CliRunner().invoke(adding.app, [*arguments, *more], catch_exceptions=False).output


def _truth(data: DataRoot) -> pd.DataFrame:
    return pd.read_parquet(data.run("tiny", "room", "align") / "ground_truth.parquet")


def _files(data: DataRoot) -> dict[str, str]:
    """Hashes of the captures and of all that stages wrote."""
    folders = (data.captures("room"), *(data.run("tiny", "room", name) for name in _STAGES))
    return {
        str(f): h
        for folder in folders
        for f, h in hash_files(data.root, (p for p in folder.rglob("*") if p.is_file())).items()
    }


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three walks in one room."""
    folder = tmp_path_factory.mktemp("walks")
    for name, (height_m, distance_m) in _WALKS.items():
        make_recording(folder / name, _FRAMES, height_m, distance_m)
    return folder


def _with(root: Path, walks: Path, *names: str) -> DataRoot:
    data = DataRoot(root)
    for name in names:
        shutil.copytree(walks / name, data.captures("room") / name)
    (root / "scenes").mkdir()
    (root / "scenes" / "room.toml").write_text(_CONFIG)
    _build(data)
    return data


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, walks: Path) -> Path:
    """Ground truth of two walks."""
    return _with(tmp_path_factory.mktemp("two"), walks, "one", "two").root


@pytest.fixture
def data(tmp_path: Path, finished: Path) -> DataRoot:
    """The same, to be changed."""
    return DataRoot(Path(shutil.copytree(finished, tmp_path / "data")))


def test_an_added_walk_leaves_the_others_as_they_are_and_can_be_taken_out(data: DataRoot, walks: Path) -> None:
    before = _truth(data).set_index("frame_id")
    said = _command(data, "add", str(walks / "three"))
    assert "room, version 2: three added, 10 of 10 frames with ground truth" in said
    after = _truth(data).set_index("frame_id")
    pd.testing.assert_frame_equal(after.loc[before.index], before, check_exact=True)
    assert set(after.loc[after["session_id"] == "three", "quality"]) <= {"A", "B"} and len(after) == 3 * _FRAMES
    # It is what the scene is made of: nothing is to be made again but what comes after.
    todo = [s.command for s in steps(data, "tiny", "room", "align") if not is_step_up_to_date(s, "tiny", data)]
    assert todo == ["report"]

    _command(data, "remove", "three")
    pd.testing.assert_frame_equal(_truth(data).set_index("frame_id"), before, check_exact=True)
    versions = pd.read_parquet(data.run("tiny", "room", "align") / "versions.parquet")
    assert versions[["version", "change", "session_id"]].to_numpy().tolist() == [
        [1, "built", "one"],
        [1, "built", "two"],
        [2, "added", "three"],
        [3, "removed", "three"],
    ]
    assert (data.captures("room") / ".removed" / "three" / "frames.jsonl").is_file()


@pytest.mark.parametrize("is_link", [True, False])
def test_a_walk_is_added_to_captures_that_are_one_recording(tmp_path: Path, walks: Path, is_link: bool) -> None:
    """As of `groundwalk run --captures one`: they become a folder of recordings, and a folder that was linked stays."""
    data, one = DataRoot(tmp_path / "data"), Path(shutil.copytree(walks / "one", tmp_path / "one"))
    captures = data.captures("room")
    captures.parent.mkdir(parents=True)
    if is_link:
        captures.symlink_to(one)
    else:
        shutil.copytree(one, captures)
    (data.root / "scenes").mkdir()
    (data.root / "scenes" / "room.toml").write_text(_CONFIG)
    _build(data)
    before, name = _truth(data).set_index("frame_id"), "one" if is_link else "room"
    assert "room, version 2: three added, 10 of 10 frames" in _command(data, "add", str(walks / "three"))
    after = _truth(data).set_index("frame_id")
    pd.testing.assert_frame_equal(after.loc[before.index], before, check_exact=True)
    assert set(after["session_id"]) == {name, "three"}
    assert {p.name for p in captures.iterdir()} == {name, "three"} and not captures.is_symlink()
    assert {p.name for p in one.iterdir()} == {p.name for p in (walks / "one").iterdir()}
    todo = [s.command for s in steps(data, "tiny", "room", "align") if not is_step_up_to_date(s, "tiny", data)]
    assert todo == ["report"]


def test_no_millimetres_are_told_of_a_map_without_metric_scale(
    data: DataRoot, capsys: pytest.CaptureFixture[str]
) -> None:
    adding._tell(data, "tiny", "room")
    assert "median standard deviation" in capsys.readouterr().out
    put(data, "room", "align", "ground_truth", _truth(data).assign(scale_source="none"))
    adding._tell(data, "tiny", "room")
    assert "version 1: one built" in (said := capsys.readouterr().out) and "deviation" not in said


@pytest.mark.slow
def test_an_added_walk_is_as_exact_as_in_a_rebuild(data: DataRoot, walks: Path, tmp_path: Path) -> None:
    """Whose frame differs by a turn about the vertical and a shift."""
    _command(data, "add", str(walks / "three"))
    after = _truth(data).set_index("frame_id")
    rebuilt = _truth(_with(tmp_path / "all", walks, *_WALKS)).set_index("frame_id").loc[after.index]
    poses, others = poses_of(after, "map_cam"), poses_of(rebuilt, "map_cam")
    placed = fit_yaw(others[:, :3, 3], poses[:, :3, 3]) @ poses
    is_new = (after["session_id"] == "three").to_numpy()
    off_m = np.linalg.norm(placed[:, :3, 3] - others[:, :3, 3], axis=1)[is_new]
    off_rad = rotation_angle(np.swapaxes(placed[:, :3, :3], 1, 2) @ others[:, :3, :3])[is_new]
    assert off_m.max() < 0.01 and np.degrees(off_rad).max() < 0.05
    # Neither surer than a rebuild, which moves all to fit, nor much less.
    ratio = after.loc[is_new, "position_sd_m"] / rebuilt.loc[is_new, "position_sd_m"]
    assert 0.8 < ratio.median() < 3


def test_a_walk_that_does_not_fit_is_refused_with_the_reason_and_changes_nothing(
    data: DataRoot, walks: Path, tmp_path: Path
) -> None:
    make_recording(tmp_path / "elsewhere", _FRAMES, 1.4, 2.5, seed=20)
    shutil.copytree(walks / "one", tmp_path / "again")
    for path in shutil.copytree(walks / "three", tmp_path / "broken").glob("*.json*"):
        path.write_bytes(b"")
    before = _files(data)
    for recording, reason in (
        (tmp_path / "elsewhere", "don't fit the map"),
        (tmp_path / "again", "again is a recording that the scene has already"),
        (tmp_path / "broken", "isn't its header"),
        (walks / "one", "the captures have one already"),
        (tmp_path / "nowhere", "the recording isn't there"),
    ):
        with pytest.raises(UserError, match=reason):
            _command(data, "add", str(recording))
        assert _files(data) == before and not (data.run("tiny", "room") / ".change.partial").exists()


def test_what_there_is_not_to_take_out_is_said(tmp_path: Path) -> None:
    """A scene's name that is mistyped, and a recording that is all of the captures: the list of others was empty."""
    with pytest.raises(UserError, match="scene room has no captures"):
        _command(DataRoot(tmp_path), "remove", "one")
    written(tmp_path / "frame_00000.jpg", "")
    with pytest.raises(UserError, match="several recordings, each in a folder of its own"):
        adding._path_of(tmp_path, "one")


def test_what_cannot_be_copied_is_named_with_the_cause_and_nothing_is_left(
    data: DataRoot, walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def add(name: str) -> str:
        with pytest.raises(SystemExit) as ended:
            adding.app(["add", str(tmp_path / name), "--scene", "room", "--profile", "tiny", "--data", str(data.root)])
        assert ended.value.code == 2 and not (data.run("tiny", "room") / ".change.partial").exists()
        return capsys.readouterr().err

    def full(source: str, target: str, **_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", source, None, target)

    shutil.copytree(walks / "three", tmp_path / "linked")
    (tmp_path / "linked" / "latest.jpg").symlink_to("gone")
    said = add("linked")
    assert "error: a file can't be copied" in said and "No such file" in said
    assert str(tmp_path / "linked" / "latest.jpg") in said
    (tmp_path / "linked" / "latest.jpg").unlink()
    (tmp_path / "walk.mp4").write_bytes(b"a video")
    monkeypatch.setattr(shutil, "copyfile", full)
    said = add("linked")
    assert str(tmp_path / "linked") in said and re.search(r"(?s)No space left on device: .*free some space", said)
    assert re.search(r"(?s)no space left on device.*walk.mp4.*free some space", add("walk.mp4"))


def test_captures_that_are_links_into_a_hidden_folder_stay_as_import_saw_them(
    data: DataRoot, walks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As git-annex keeps them. Those that import refused are as they were, too."""
    captures, seen = data.captures("room"), list[dict[str, str]]()

    def hashes(folder: Path) -> dict[str, str]:
        return hash_files(folder, (path for path in capture_files(folder) if path.is_file()))

    def look(stage: object, scene: str, profile: str, changed: DataRoot, *_: object) -> None:
        seen.append(hashes(changed.captures(scene)))
        assert (changed.captures(scene) / "two" / "out.jpg").resolve() == tmp_path / "out.jpg"
        raise _Killed

    kept = captures / ".git" / "annex"
    kept.mkdir(parents=True)
    for file in capture_files(captures / "one"):
        file.rename(kept / file.name)
        file.symlink_to(os.path.relpath(kept / file.name, file.parent))
    (tmp_path / "out.jpg").write_bytes(b"elsewhere")
    (captures / "two" / "out.jpg").symlink_to("../../../../out.jpg")
    (captures / "two" / "loop.jpg").symlink_to("loop.jpg")
    monkeypatch.setattr(stage, "execute", look)
    monkeypatch.setattr(adding, "_keys", lambda *_: {})
    with pytest.raises(_Killed):
        _command(data, "add", str(walks / "three"))
    added = {f"three/{name}": digest for name, digest in hashes(walks / "three").items()}
    assert seen == [hashes(captures) | added] and "one/frames.jsonl" in seen[0]


def test_what_shares_images_with_a_recording_that_is_taken_out_keeps_them(tmp_path: Path) -> None:
    data, aside = DataRoot(tmp_path / "data"), tmp_path / "aside"
    captures = data.captures("room")
    written(captures / "one" / "images" / "0.jpg", "an image")
    (captures / "two").mkdir()
    (link := captures / "two" / "0.jpg").symlink_to("../one/images/0.jpg")
    (captures / "one" / "first.jpg").symlink_to("images/0.jpg")
    written(aside / "key.json", '{"done": "one"}')
    adding._put_in_place(aside, data, "tiny", "room", is_new=False)
    assert link.read_text() == "an image" and not link.is_symlink()
    assert (captures / ".removed" / "one" / "first.jpg").is_symlink()
    assert {path.name for path in captures.iterdir()} == {"two", ".removed"}


def test_a_command_that_the_machine_ends_resumes_as_it_says(
    data: DataRoot, walks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise MachineError("no space left on device", do="free some space; the same command resumes")

    aside = data.run("tiny", "room") / ".change.partial"
    with monkeypatch.context() as patched, pytest.raises(MachineError):
        patched.setattr(stage, "execute", full)
        _command(data, "add", str(walks / "three"))
    made = written(aside / "runs" / "tiny" / "room" / ".sfm.partial" / "scratch" / "made", "")

    def look(*_: object) -> None:
        assert made.exists()
        raise _Killed

    with pytest.raises(_Killed):
        monkeypatch.setattr(stage, "execute", look)
        _command(data, "add", str(walks / "three"))


@pytest.mark.slow
@pytest.mark.parametrize("where", ["a stage", "moving"])
def test_a_command_that_was_killed_is_finished_by_the_same_one(
    data: DataRoot, walks: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    before, killed = _files(data), False

    def kill_once(function: Callable[..., object]) -> Callable[..., object]:
        def killing(*arguments: object) -> object:
            nonlocal killed
            if not killed and (where == "moving" or getattr(arguments[0], "name", "") == "align"):
                killed = True
                raise _Killed
            return function(*arguments)

        return killing

    if where == "moving":
        monkeypatch.setattr(adding, "swap_in", kill_once(adding.swap_in))
    else:
        monkeypatch.setattr(stage, "execute", kill_once(stage.execute))
    with pytest.raises(_Killed):
        _command(data, "add", str(walks / "three"))
    if where == "a stage":
        assert _files(data) == before
    said = _command(data, "add", str(walks / "three"))
    assert "version 2: three added" in said and not (data.run("tiny", "room") / ".change.partial").exists()
    todo = [s.command for s in steps(data, "tiny", "room", "align") if not is_step_up_to_date(s, "tiny", data)]
    assert todo == ["report"]
