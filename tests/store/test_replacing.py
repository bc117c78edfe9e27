"""A folder takes another one's place whole, with what its writer didn't make; where it can't, that is said first."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from groundwalk.store import DataRoot, StageRun, UserError, execute
from groundwalk.store.files import finish_interrupted_swap, fresh_folder, old_folder
from groundwalk.store.locks import lock_file, locked
from tests.store.places import NoSettings, stage


def one_file(r: StageRun[NoSettings]) -> None:
    (r.work / "model").mkdir()
    (r.work / "model" / "points.bin").write_text("points")


def files_in(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


def test_a_note_in_an_artefact_outlives_the_next_run(data: DataRoot) -> None:
    folder = execute(stage(one_file, "sfm"), "place", "own", data)
    (folder / "model" / "note.txt").write_text("mine")

    def other_files(r: StageRun[NoSettings]) -> None:
        if not (folder / "colour").exists():
            (folder / "colour").write_text("came while it ran")
        for name in ("model", "colour"):  # where the notes would be
            (r.work / name).write_text("new")

    execute(stage(one_file, "sfm"), "place", "own", data, force=True)
    assert files_in(folder)["model/note.txt"] == "mine"
    for _ in range(2):
        execute(stage(other_files, "sfm"), "place", "own", data, force=True)
    names = files_in(folder)
    assert names.pop("manifest.json")
    assert names == {
        "model": "new",
        "colour": "new",
        "colour.kept": "came while it ran",
        "model-note.txt.kept": "mine",
    }


@pytest.mark.parametrize("killed", ["between the renames", "before the old one is dropped"])
def test_a_note_outlives_a_kill(data: DataRoot, killed: str) -> None:
    folder = execute(stage(one_file, "sfm"), "place", "own", data)
    (folder / "note.txt").write_text("mine")
    folder.rename(folder.with_name(".sfm.old"))
    if killed != "between the renames":
        folder.mkdir()
        for name, text in (("manifest.json", (folder.parent / ".sfm.old" / "manifest.json").read_text()), ("x", "x")):
            (folder / name).write_text(text)
    execute(stage(one_file, "sfm"), "place", "own", data, force=True)
    assert files_in(folder)["note.txt"] == "mine"
    assert not folder.with_name(".sfm.old").exists()


@pytest.mark.parametrize("hidden", ["sfm", ".sfm.partial"])
def test_a_stages_folder_that_is_a_link_is_refused_before_its_work(data: DataRoot, tmp_path: Path, hidden: str) -> None:
    """And made once the link is away; a link above it does no harm."""
    elsewhere, scene = tmp_path / "elsewhere", data.run("own", "place")
    elsewhere.mkdir()
    scene.parent.mkdir(parents=True)
    scene.symlink_to(tmp_path / "disk")
    (tmp_path / "disk").mkdir()
    link = scene / hidden
    link.symlink_to(elsewhere)
    worked: list[StageRun[NoSettings]] = []
    for _ in range(2):
        with pytest.raises(UserError, match=r"(?s)can't be\n.*found: +a link\n.*move it away"):
            execute(stage(worked.append, "sfm"), "place", "own", data)
    assert not worked and not any(elsewhere.iterdir())
    link.unlink()
    execute(stage(one_file, "sfm"), "place", "own", data)


def test_a_file_or_a_mounted_disk_in_a_folders_place_is_refused_before_the_work(
    data: DataRoot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = data.run("own", "place", "sfm")
    place.parent.mkdir(parents=True)
    place.write_text("a file")
    with pytest.raises(UserError, match=r"found: +a file"):
        execute(stage(lambda r: pytest.fail("worked"), "sfm"), "place", "own", data)
    with pytest.raises(UserError, match=r"found: +a file"), fresh_folder(place):
        pytest.fail("worked")
    place.unlink()
    place.mkdir()
    monkeypatch.setattr(Path, "is_mount", lambda self: self == place)
    with pytest.raises(UserError, match=r"found: +a disk of its own"):
        execute(stage(lambda r: pytest.fail("worked"), "sfm"), "place", "own", data)


def test_a_link_in_the_place_of_a_folder_that_was_replaced_never_becomes_the_folder(
    data: DataRoot, tmp_path: Path
) -> None:
    final, elsewhere = data.run("tiny", "room", "first"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    final.parent.mkdir(parents=True)
    old_folder(final).symlink_to(elsewhere, target_is_directory=True)
    finish_interrupted_swap(final, "manifest.json", lambda folder: set())
    assert not os.path.lexists(final) and not os.path.lexists(old_folder(final)) and elsewhere.is_dir()


def test_what_comes_to_an_output_folder_while_it_is_written_anew_stays(tmp_path: Path) -> None:
    out, link = tmp_path / "out", tmp_path / "link"
    out.mkdir()
    (out / "old.txt").write_text("an earlier result")
    link.symlink_to(out)
    for name, place in (("one", out), ("two", link)):
        with fresh_folder(place) as folder:
            (folder / "new.txt").write_text(name)
            (out / f"{name}.txt").write_text("mine")
    assert link.is_symlink()
    # What was there as the second began had passed as an earlier result.
    assert files_in(out) == {"new.txt": "two", "two.txt": "mine"}


LOCKS: dict[str, Callable[[Path], object]] = {
    "link to nothing": lambda path: path.symlink_to(path.with_name("nothing") / "there"),
    "link to itself": lambda path: path.symlink_to(path),
    "link to a file": lambda path: path.symlink_to(path.with_name("diary")),
    "folder": lambda path: path.mkdir(),
}


@pytest.mark.parametrize("kind", LOCKS)
def test_a_lock_that_is_no_file_is_an_error_at_once(tmp_path: Path, kind: str) -> None:
    (tmp_path / "diary").write_text("dear")
    LOCKS[kind](lock_file(tmp_path / "sfm"))
    with pytest.raises(OSError) as told, locked(tmp_path / "sfm"):
        pass
    assert told.value.errno in (errno.ELOOP, errno.EISDIR)
    assert told.value.filename == str(lock_file(tmp_path / "sfm"))


def test_a_folder_that_cannot_be_synced_is_left_to_its_drive(data: DataRoot, monkeypatch: pytest.MonkeyPatch) -> None:
    fsync = os.fsync

    def of_files_alone(descriptor: int) -> None:
        if Path(f"/proc/self/fd/{descriptor}").is_dir():
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", of_files_alone)
    assert files_in(execute(stage(one_file, "sfm"), "place", "own", data))["model/points.bin"] == "points"
