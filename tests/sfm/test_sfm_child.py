"""Work in a child process: its result, its errors, its death."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from artefacts import UserError
from sfm.child import Report, in_child


def _double(report: Report, value: int) -> int:
    report(1)
    return 2 * value


def _refuse(report: Report) -> None:
    raise UserError("the setting is wrong", do="mend it")


def _abort(report: Report) -> None:
    os.write(2, b"check failed: points != nullptr\n")
    os.abort()


def _write_for_ever(report: Report, path: Path) -> None:
    while True:
        path.write_text(str(time.time()))
        time.sleep(0.02)


def test_the_result_comes_back(tmp_path: Path) -> None:
    assert in_child(_double, "doubling", 1, tmp_path / "log", 21) == 42


def test_an_error_in_the_child_is_raised_here(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="the setting is wrong"):
        in_child(_refuse, "refusing", None, tmp_path / "log")


def test_an_aborted_child_is_an_error_with_the_end_of_its_log(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        in_child(_abort, "extracting features", 3, tmp_path / "log")
    assert "SIGABRT" in str(caught.value)
    assert "check failed: points != nullptr" in str(caught.value)


def test_the_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    written, script = tmp_path / "alive", tmp_path / "parent.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        f"from {Path(__file__).stem} import _write_for_ever, in_child, Path\n"
        f"if __name__ == '__main__':\n"
        f"    in_child(_write_for_ever, 'writing', None, Path({str(tmp_path / 'log')!r}), Path({str(written)!r}))\n"
    )
    parent = subprocess.Popen([sys.executable, script])
    try:
        _wait_until(written.exists)
    finally:
        parent.kill()
        parent.wait()

    def stands_still() -> bool:
        before = written.read_text()
        time.sleep(0.3)
        return written.read_text() == before

    _wait_until(stands_still)


def _wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.05)
