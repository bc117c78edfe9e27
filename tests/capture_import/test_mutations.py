"""Damaged and hostile captures end in a correct import with rejects, or in an error on one screen."""

import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.capture_import.tables import rejects_table
from groundwalk.geometry.poses import rigidity_error
from groundwalk.store import UserError
from groundwalk.store.choices import PoseSource
from tests.capture_import.capture_writers import WRITERS, make_walk

Random = np.random.Generator

SECONDS = 20
LINES = 40
_HOSTILE = (
    b"NaN", b"Infinity", b"-1e400", b"1e308", b"null", b"true", b'"x"', b"[]", b"{}", b"9" * 400, b"-0", b"", b"\xff",
    b"1e-320", b"9223372036854775808", b"[[1]]", b'"../../../etc/passwd"', b'"\\u0000"', b"[" * 20000,
)  # fmt: skip


def _flip_bytes(path: Path, rng: Random) -> None:
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, max(len(data), 1), rng.integers(1, 20)):
        if data:
            data[at] = rng.integers(0, 256)
    path.write_bytes(data)


def _truncate(path: Path, rng: Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(0, len(data) + 1)])


def _junk(path: Path, rng: Random) -> None:
    path.write_bytes(rng.bytes(int(rng.integers(1, 5000))) if rng.random() < 0.7 else b"")


def _replace(path: Path, rng: Random, pattern: bytes, new: bytes) -> None:
    data = path.read_bytes()
    if found := list(re.finditer(pattern, data)):
        at = found[rng.integers(len(found))]
        path.write_bytes(data[: at.start()] + new + data[at.end() :])


def _hostile_value(path: Path, rng: Random) -> None:
    _replace(path, rng, rb"-?\d+\.?\d*(e-?\d+)?", _HOSTILE[rng.integers(len(_HOSTILE))])


def _rename_key(path: Path, rng: Random) -> None:
    _replace(path, rng, rb'"(\w+)":', b'"other":')


def _shuffle_lines(path: Path, rng: Random) -> None:
    lines = path.read_bytes().split(b"\n")
    order = rng.permutation(len(lines)) if rng.random() < 0.5 else rng.integers(0, len(lines), len(lines))
    path.write_bytes(b"\n".join(lines[i] for i in order))


def _no_file(path: Path, rng: Random) -> None:
    path.unlink()
    kinds: list[Callable[[], object]] = [
        lambda: None,
        lambda: path.symlink_to("/etc/hostname"),
        lambda: path.symlink_to(path.name),
        path.mkdir,
        lambda: os.mkfifo(path),
    ]
    kinds[rng.integers(len(kinds))]()


def _other_file(path: Path, rng: Random) -> None:
    others = [p for p in sorted(path.parent.iterdir()) if p.is_file() and not p.is_symlink()]
    shutil.copyfile(others[rng.integers(len(others))], path.with_name("copy"))
    path.with_name("copy").replace(path)


def _odd_name(path: Path, _: Random) -> None:
    path.rename(os.fsdecode(os.fsencode(path) + b"\xff\n"))


MUTATIONS: tuple[Callable[[Path, Random], None], ...] = (
    _flip_bytes, _truncate, _junk, _junk, _hostile_value, _hostile_value, _hostile_value, _rename_key, _shuffle_lines,
    _shuffle_lines, _no_file, _no_file, _no_file, _no_file, _no_file, _other_file, _odd_name,
)  # fmt: skip


def mutate(folder: Path, rng: Random) -> list[str]:
    """Damage one to three files below `folder`; returns what was done."""
    done = []
    for _ in range(rng.integers(1, 4)):
        files = [p for p in sorted(folder.rglob("*")) if p.is_file() and not p.is_symlink()]
        # Logs are few and images many; half of the damage is to logs.
        logs = [p for p in files if p.suffix not in (".jpg", ".png")]
        chosen = logs if logs and rng.random() < 0.7 else files
        if not chosen:
            break
        path = chosen[rng.integers(len(chosen))]
        mutation = MUTATIONS[rng.integers(len(MUTATIONS))]
        mutation(path, rng)
        done.append(f"{mutation.__name__} {path.name}")
    return done


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
