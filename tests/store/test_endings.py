"""How a command ends: by a signal, on a full disk, in a folder that can't be written; always with a sentence."""

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from groundwalk.store import DataRoot, StageRun, UserError, execute
from groundwalk.store.child import ProcessDied, Report, Task, in_child, preload
from groundwalk.store.cli import stage_app
from groundwalk.store.files import STOPPED, partial_folder
from groundwalk.store.registry import Lazy
from groundwalk.store.signals import Stopped, handlers_kept, signals_raise
from tests.known import filled, wait_until
from tests.store.places import NoSettings, stage

WAITING = "waiting"
RESUMES = "the same command resumes from the last checkpoint"
FORCED = "with --force the same command starts anew; without it, it resumes, unless the artefact is up to date"


def wait_in_child(report: Report, flag: Path) -> None:
    flag.touch()
    time.sleep(60)


def wait(r: StageRun[NoSettings]) -> None:
    in_child("waiting", r.scratch / "log", "", Task(wait_in_child, (r.data.root / WAITING,)))


def wait_beside_colmap(r: StageRun[NoSettings]) -> None:
    """As sfm does: pycolmap is loaded when the stage runs, and in the process that its children are forked from."""
    Lazy("pycolmap:Reconstruction").load()
    preload("pycolmap")
    wait(r)


@pytest.mark.parametrize(
    ("run", "number", "group", "options", "again"),
    [
        ("wait", signal.SIGINT, True, (), RESUMES),
        ("wait", signal.SIGTERM, False, ("--force",), FORCED),
        ("wait_beside_colmap", signal.SIGTERM, True, (), RESUMES),
        pytest.param("wait", signal.SIGINT, False, (), RESUMES, marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_a_stage_with_one_line_and_its_exit_code(
    data: DataRoot, run: str, number: signal.Signals, group: bool, options: tuple[str, ...], again: str
) -> None:
    program = (
        "from tests.store import test_endings\n"
        f"test_endings.stage_app(test_endings.stage(test_endings.{run}))("
        f"['--scene', 'place', '--profile', 'tiny', '--data', {str(data.root)!r}, *{options}])"
    )
    command = [sys.executable, "-c", program]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_until((data.root / WAITING).exists)
    (os.killpg if group else os.kill)(process.pid, number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert out == "" and err == f"import · place · tiny\nstopped by {number.name}; {again}\n"


@pytest.mark.parametrize(("force", "again"), [(False, "resumes from the last"), (True, "starts anew")])
def test_advice_after_a_failure_says_what_the_same_command_does(data: DataRoot, force: bool, again: str) -> None:
    def dies(r: StageRun[NoSettings]) -> None:
        raise ProcessDied("matching: its process died", do="take fewer", exit_code=1)

    def fills(r: StageRun[NoSettings]) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(r.work))

    for run, advice in ((dies, "take fewer; "), (fills, "free some space; ")):
        with pytest.raises(UserError, match=f"{advice}.*{again}"):
            execute(stage(run), "place", "tiny", data, force=force)
        # Neither says anything of the capture: the report has it not judged yet, and not refused.
        assert not (partial_folder(data.run("tiny", "place", "import")) / STOPPED).exists()


LIBRARY = "a library's"
CALLS = [
    *("os.open", "os.fsync", "fcntl.flock"),
    *(f"pathlib.Path.{n}" for n in ("rename", "replace", "mkdir")),
    LIBRARY,
]
DISKS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO}
NETWORK = {errno.ENOLCK, errno.EOPNOTSUPP, errno.EBUSY, errno.ESTALE, errno.EXDEV, errno.ENOSYS}


@pytest.mark.parametrize("call", CALLS)
def test_every_error_of_the_disk_anywhere_is_a_sentence(
    data: DataRoot, call: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    numbers = {*DISKS, *NETWORK, *sorted(errno.errorcode)[CALLS.index(call) :: len(CALLS)]}
    may_be_the_librarys_fault = {errno.ENOENT, errno.EISDIR, errno.EINVAL, errno.EBADF} if call == LIBRARY else set()
    for number in sorted(numbers - may_be_the_librarys_fault - {errno.EPIPE}):

        def fail(*_: object, number: int = number, **__: object) -> None:
            # The system names no file where a call has its number alone.
            raise OSError(number, os.strerror(number), *([] if call in ("os.fsync", "fcntl.flock") else ["/disk/x"]))

        def run(r: StageRun[NoSettings], fail: Callable[[], None] = fail) -> None:
            if call == LIBRARY:
                try:
                    fail()
                except OSError as error:  # as libraries do that hide the cause
                    raise RuntimeError("No registered database factory succeeded.") from error
            r.write("rejects", filled("import", "rejects", 1))

        with monkeypatch.context() as patched, pytest.raises(SystemExit) as ended:
            if call != LIBRARY:
                patched.setattr(call, fail)
            stage_app(stage(run))(["--scene", "place", "--profile", "tiny", "--data", str(data.root)])
        said = capsys.readouterr().err
        assert ended.value.code == 2 and re.search(rf"where:    (/disk/x|{data.root}/)", said), said
        assert ("MiB free" in said) == (number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG))
        assert not data.run("tiny", "place", "import").exists()


def test_a_library_that_fails_on_a_full_disk_is_blamed_on_the_disk(
    data: DataRoot, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 3 << 20})

    def fail(r: StageRun[NoSettings]) -> None:
        raise RuntimeError("No registered database factory succeeded.")

    def fill_and_fail(r: StageRun[NoSettings]) -> None:
        monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
        fail(r)

    with pytest.raises(RuntimeError):
        execute(stage(fail), "place", "tiny", data)
    with pytest.raises(UserError, match=r"(?s)no space left on device.*3 MiB free; No registered.*resumes") as told:
        execute(stage(fill_and_fail), "place", "tiny", data)
    assert str(data.root) in str(told.value)


def test_a_stage_says_beforehand_that_the_disk_has_too_little_room(
    data: DataRoot, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 3 << 20})
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
    with pytest.raises(UserError, match=r"(?s)nearly full.*about 16 MiB for this stage.*3 MiB free"):
        execute(stage(lambda r: None), "place", "tiny", data)
    assert not data.run("tiny", "place", "import").exists()


def test_a_stop_that_python_hides_in_another_error_is_still_a_stop(
    data: DataRoot, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it does where a signal comes while a class is made: an import of SciPy."""

    def hidden(r: StageRun[NoSettings]) -> None:
        try:
            raise Stopped(signal.SIGTERM)
        except Stopped as stopped:
            raise RuntimeError("Error calling __set_name__") from stopped

    with pytest.raises(SystemExit) as ended:
        stage_app(stage(hidden))(["--scene", "place", "--profile", "tiny", "--data", str(data.root)])
    assert ended.value.code == 143 and capsys.readouterr().err.endswith("resumes from the last checkpoint\n")


def test_a_signal_that_comes_while_modules_are_loaded_waits() -> None:
    is_held = False
    with signals_raise(), pytest.raises(Stopped), handlers_kept():
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        is_held = True
    assert is_held
