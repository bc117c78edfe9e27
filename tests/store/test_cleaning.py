"""Clean removes what this program made, and nothing else, whatever the names and wherever links lead."""

import hashlib
import json
import tracemalloc
from pathlib import Path

import pytest

from groundwalk.store import DataRoot, UserError
from groundwalk.store.cleaning import clean_scene
from groundwalk.store.locks import locked
from tests.known import written

HOSTILE_NAMES = ["", ".", "..", "../captures", "/etc", "a/b", "a b", "-x", ".x", "x\n", "x\0", "x" * 250]


def artefact(folder: Path, **files: str) -> Path:
    """A finished artefact as a stage leaves it."""
    for name, text in files.items():
        written(folder / name, text)
    outputs = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()}
    (folder / "manifest.json").write_text(json.dumps({"stage": folder.name, "key": "k", "outputs": outputs}))
    (folder / "recording.rrd").write_text("a view")
    return folder


def simulated_capture(folder: Path) -> Path:
    for name in ("info.json", "frame_00000.json", "frame_00000.jpg", "frame_00001.json"):
        written(folder / "walk" / name, "{}")
    (folder / "true_poses.parquet").write_text("poses")
    (folder / "SIMULATED.json").write_text(json.dumps({"key": "k", "sessions": {"walk": {"poses": 2, "images": 1}}}))
    return folder


def real_capture(folder: Path) -> Path:
    return written(folder / "frame_00000.json", "{}").parent


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() or path.is_symlink()}


@pytest.fixture
def data(tmp_path: Path) -> DataRoot:
    return DataRoot(tmp_path / "data")


def test_artefacts_partial_runs_and_simulated_captures_are_removed(data: DataRoot) -> None:
    runs = data.run("demo", "mine")
    artefact(runs / "import", frames="f")
    (artefact(runs / "sfm", images="i") / "empty").mkdir()
    artefact(runs / "align", truth="t").rename(runs / ".align.old")
    (runs / ".train.partial" / "scratch").mkdir(parents=True)
    written(runs / ".train.partial" / "key.json", '{"key": "k"}')
    (runs / ".train.lock").touch()
    other = artefact(data.run("paper", "mine") / "import", frames="f")
    simulated_capture(data.captures("mine"))
    cleaned = clean_scene(data, "demo", "mine")
    assert cleaned.left == []
    assert not runs.exists() and not data.captures("mine").exists()
    assert (other / "frames").is_file()


@pytest.mark.parametrize("name", HOSTILE_NAMES)
def test_no_name_leads_elsewhere(data: DataRoot, name: str) -> None:
    real_capture(data.captures("mine"))
    artefact(data.root / "runs" / "mine" / "import", frames="f")  # where an empty profile would lead
    before = files_below(data.root.parent)
    for profile, scene in ((name, "mine"), ("demo", name)):
        with pytest.raises(UserError, match="can't be the name of a"):
            clean_scene(data, profile, scene)
        with pytest.raises(UserError, match="can't be the name of a"):
            data.run(profile, scene, "import")
    for read in (data.profile, data.scene, data.captures):
        with pytest.raises(UserError, match="can't be the name of a"):
            read(name)
    assert files_below(data.root.parent) == before


def test_what_this_program_did_not_make_is_named_and_left(data: DataRoot) -> None:
    runs = data.run("demo", "mine")
    notes = artefact(runs / "sfm", images="i") / "notes.txt"
    notes.write_text("mine")
    foreign = [
        real_capture(runs / "walk"),
        real_capture(runs / "import"),  # a stage's name, but no manifest
        real_capture(runs / ".train.partial"),  # hidden, but no key file
    ]
    for number, manifest in enumerate(
        ("null", "[]", "{}", '{"stage": "fuse"}', '{"stage": "fuse", "outputs": 3}', "\xff")
    ):
        foreign.append(real_capture(data.run("demo", f"other{number}") / "fuse"))
        (foreign[-1] / "manifest.json").write_text(manifest, encoding="latin-1")
    before = {path: files_below(path) for path in foreign}
    cleaned = clean_scene(data, "demo", "mine")
    assert cleaned.left == [notes, runs / ".train.partial", runs / "import", runs / "walk"]
    assert files_below(runs / "sfm") == {"notes.txt"}
    for number in range(6):
        folder = data.run("demo", f"other{number}")
        assert clean_scene(data, "demo", folder.name).left == [folder / "fuse"]
    assert {path: files_below(path) for path in foreign} == before


def test_captures_of_ones_own_beside_simulated_ones_are_left(data: DataRoot) -> None:
    captures = simulated_capture(data.captures("mine"))
    real_capture(captures / "real")
    (captures / "walk" / "video.mp4").write_text("mine")
    cleaned = clean_scene(data, "demo", "mine")
    assert files_below(captures) == {"real/frame_00000.json", "walk/video.mp4"}
    assert set(cleaned.left) == {captures / "real" / "frame_00000.json", captures / "walk" / "video.mp4"}
    damaged = simulated_capture(data.captures("damaged"))
    (damaged / "SIMULATED.json").write_text('{"sessions": 3}')
    assert clean_scene(data, "demo", "damaged").left == [damaged]
    assert len(files_below(damaged)) == 6


def test_no_link_is_followed(data: DataRoot, tmp_path: Path) -> None:
    elsewhere = artefact(tmp_path / "elsewhere" / "sfm", images="i")
    simulated_capture(tmp_path / "elsewhere" / "captures")
    before = files_below(tmp_path / "elsewhere")
    runs = data.run("demo", "mine")
    inside = artefact(runs / "import", frames="f")
    (inside / "linked").symlink_to(elsewhere, target_is_directory=True)
    (runs / "sfm").symlink_to(elsewhere, target_is_directory=True)
    data.run("demo", "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (data.root / "runs" / "linked").symlink_to(tmp_path, target_is_directory=True)
    data.captures("mine").parent.mkdir()
    data.captures("mine").symlink_to(tmp_path / "elsewhere" / "captures", target_is_directory=True)
    assert clean_scene(data, "demo", "mine").left == [inside / "linked", runs / "sfm"]
    for profile, scene in (("demo", "linked"), ("linked", "elsewhere")):
        assert clean_scene(data, profile, scene).left == [data.run(profile, scene)]
    assert files_below(tmp_path / "elsewhere") == before


def test_nothing_is_removed_while_a_stage_is_under_way(data: DataRoot) -> None:
    runs = data.run("demo", "mine")
    artefact(runs / "import", frames="f")
    simulated_capture(data.captures("mine"))
    (runs / ".sfm.partial").mkdir()
    before = files_below(data.root)
    for busy in (runs / "sfm", data.captures("mine")):
        with locked(busy, shared=True), pytest.raises(UserError, match="under way"):
            clean_scene(data, "demo", "mine")
        assert before <= files_below(data.root)
    clean_scene(data, "demo", "mine")
    assert not runs.exists()


@pytest.mark.parametrize("poses", [10**12, -1, "many", 1e308])
def test_a_marker_that_counts_too_many_frames_costs_no_memory(tmp_path: Path, poses: object) -> None:
    data = DataRoot(tmp_path)
    folder = simulated_capture(data.captures("place"))
    (folder / "walk" / "frame_1.json").write_text("not a name that the simulator gives")
    (folder / "SIMULATED.json").write_text(json.dumps({"sessions": {"walk": {"poses": poses, "images": 1}}}))
    tracemalloc.start()
    clean_scene(data, "tiny", "place")
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()
    assert (folder / "walk" / "frame_1.json").is_file()
