"""Damaged and hostile captures end in a correct import with rejects, or in an error on one screen."""

import shutil
import signal
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.archive import unpack
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.capture_import.tables import rejects_table
from groundwalk.geometry.poses import rigidity_error
from groundwalk.store import UserError
from groundwalk.store.choices import PoseSource
from tests.capture_import.capture_mutations import mutate
from tests.capture_import.capture_writers import WRITERS, make_walk

SECONDS = 20
LINES = 40


class Hang(BaseException):
    """Not an Exception, so that nobody's error handling takes it for a broken file."""


@contextmanager
def no_longer_than(seconds: int, what: object) -> Iterator[None]:
    def stop(*_: object) -> None:
        raise Hang(f"hangs: {what}")

    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


def read_all(root: Path, unpacked: Path) -> bool:
    """Read what `root` holds and check what must hold for anything that comes out; False where it's refused."""
    limits = Limits(max_megapixels=1.0)
    try:
        for found in find_recordings(root, unpacked, limits):
            raw = found.read(limits)
            sessions = sound_sessions(raw, ImageReader([root.resolve(), unpacked.resolve()], limits).check, 0.5)
            rejects_table(sessions, {})
            for session in sessions:
                assert (np.diff(session.t_ns) > 0).all()
                if raw.pose_source != PoseSource.NONE:  # of a capture without its log images alone may be left
                    assert rigidity_error(session.poses).max(initial=0) < 1e-9
                for image in session.images:
                    camera = image.camera
                    assert 0 < camera.cx < image.check.width
                    assert 0 <= image.check.sharpness <= 1
    except UserError as error:
        assert len(str(error).splitlines()) <= LINES and len(str(error)) < 4000
        return False
    return True


def run_mutations(name: str, count: int, tmp_path: Path, seed: int) -> int:
    """Damage a walk in one format `count` times; returns how many were still imported."""
    whole = tmp_path / "whole"
    WRITERS[name].write(whole / "walk", make_walk(8))
    imported = 0
    for case in range(count):
        root = tmp_path / "case" / "place"
        shutil.copytree(whole, root)
        done = mutate(root, np.random.default_rng([seed, case]))
        with no_longer_than(SECONDS, (name, case, done)):
            try:
                imported += read_all(root, tmp_path / "case" / "unpacked")
            except Exception as error:
                raise AssertionError(f"{name}, case {case}: {done}") from error
        shutil.rmtree(tmp_path / "case")
    return imported


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_captures(tmp_path: Path, name: str) -> None:
    run_mutations(name, 15, tmp_path, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_many_damaged_captures(tmp_path: Path, name: str) -> None:
    imported = run_mutations(name, 700, tmp_path, seed=1)
    # Damage costs rows, not the capture, unless that is two files, a log and a video.
    assert imported > 50


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "a/../../evil.txt", "..\\evil.txt", "C:\\evil.txt"])
def test_archives_cannot_write_outside(tmp_path: Path, name: str) -> None:
    archive = tmp_path / "place" / "walk.zip"
    archive.parent.mkdir()
    with zipfile.ZipFile(archive, "w") as content:
        content.writestr(name, "x")
    with pytest.raises(UserError, match="refused"):
        unpack(archive, tmp_path / "deep" / "er" / "target", Limits())
    assert not list(tmp_path.rglob("evil*"))


def test_archives_with_links_or_too_many_files_are_refused(tmp_path: Path) -> None:
    linked, many = tmp_path / "linked.zip", tmp_path / "many.zip"
    with zipfile.ZipFile(linked, "w") as content:
        member = zipfile.ZipInfo("link")
        member.external_attr = (stat.S_IFLNK | 0o777) << 16
        content.writestr(member, "/etc/passwd")
    with zipfile.ZipFile(many, "w") as content:
        for i in range(20):
            content.writestr(str(i), "")
    for archive, found in ((linked, "no file or folder"), (many, "more than 10 files")):
        with pytest.raises(UserError, match=found):
            unpack(archive, tmp_path / "target", Limits(max_archive_files=10))
        assert not (tmp_path / "target").exists()
