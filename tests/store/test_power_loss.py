"""A power cut leaves what was synced. Every rename that puts something in its place must come after the sync of what it
moves, and the folder that has the new name must be synced after it."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from groundwalk.store import DataRoot, StageRun, execute
from groundwalk.store.files import fresh_folder, write_json
from groundwalk.store.schemas import schema
from groundwalk.store.tables import write_table
from tests.known import filled
from tests.store.places import NoSettings, stage


@dataclass
class Disk:
    """What was synced when: modification times of files and names in folders, as of their last fsync."""

    root: Path
    synced: dict[int, tuple[int, frozenset[str]]] = field(default_factory=dict)
    renames: list[tuple[Path, list[str]]] = field(default_factory=list)
    """each target, and what of it a power cut right after the rename could lose"""
    unsynced_folders: set[Path] = field(default_factory=set)

    @staticmethod
    def _state(path: Path) -> tuple[int, frozenset[str]]:
        status = path.stat()
        return (0, frozenset(os.listdir(path))) if path.is_dir() else (status.st_mtime_ns, frozenset())  # noqa: PTH208

    def fsync(self, descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))  # noqa: PTH115
        self.synced[path.stat().st_ino] = self._state(path)
        self.unsynced_folders.discard(path)

    def rename(self, source: Path, target: Path) -> None:
        """Called before it."""
        if not target.is_relative_to(self.root):
            return
        paths = [source, *source.rglob("*")] if source.is_dir() else [source]
        lost = [p.relative_to(source).as_posix() for p in paths if self.synced.get(p.stat().st_ino) != self._state(p)]
        self.renames.append((target, lost))
        self.unsynced_folders.add(target.parent)


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    recorder = Disk(tmp_path)
    fsync, rename, replace = os.fsync, os.rename, os.replace

    def recorded(move: Callable[..., None]) -> Callable[..., None]:
        def moved(source: str, target: str, **options: int) -> None:
            recorder.rename(Path(source), Path(target))
            move(source, target, **options)

        return moved

    def synced(descriptor: int) -> None:
        fsync(descriptor)
        recorder.fsync(descriptor)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "rename", recorded(rename))
    monkeypatch.setattr(os, "replace", recorded(replace))
    yield recorder


def some_files(r: StageRun[NoSettings]) -> None:
    (r.work / "models" / "a").mkdir(parents=True)
    (r.work / "models" / "a" / "points.bin").write_bytes(b"x" * 5000)
    r.write("rejects", filled("import", "rejects", 1))
    (r.scratch / "log").write_text("x")


@pytest.mark.parametrize("runs", [1, 2])
def test_an_artefact_is_synced_before_it_is_in_its_place(data: DataRoot, disk: Disk, runs: int) -> None:
    for _ in range(runs):
        final = execute(stage(some_files), "place", "own", data, force=True)
    finals = [lost for target, lost in disk.renames if target == final]
    assert finals == [[]] * runs
    # An old artefact that is moved aside was synced when it was new.
    assert all(lost == [] for _, lost in disk.renames)
    assert final.parent not in disk.unsynced_folders


def test_tables_json_and_folders_are_synced_before_they_are_in_their_place(tmp_path: Path, disk: Disk) -> None:
    write_table(tmp_path / "t.parquet", filled("import", "rejects", 1), schema("import", "rejects"))
    write_json(tmp_path / "a.json", {})
    with fresh_folder(tmp_path / "out") as folder:
        (folder / "x").write_text("x")
    assert [target.name for target, _ in disk.renames] == ["t.parquet", "a.json", "out"]
    assert all(lost == [] for _, lost in disk.renames) and not disk.unsynced_folders


def test_the_recorder_sees_what_is_not_synced(tmp_path: Path, disk: Disk) -> None:
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "a").write_text("x")
    (tmp_path / "new").rename(tmp_path / "final")
    assert disk.renames == [(tmp_path / "final", [".", "a"])] and disk.unsynced_folders == {tmp_path}
