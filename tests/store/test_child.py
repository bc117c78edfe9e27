"""Work in a child process: its result, its errors, its death."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from groundwalk.store import UserError
from groundwalk.store.child import Report, Task, in_child, in_children


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
    assert in_child("doubling", tmp_path / "log", "", Task(_double, (21,), 1)) == 42


def test_the_child_does_without_its_parents_main_module(tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(
        "from pathlib import Path\n"
        f"from {__name__} import _double, in_child, Task\n"
        "print('main')\n"
        f"print(in_child('doubling', Path({str(tmp_path / 'log')!r}), '', Task(_double, (21,), 1)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["main", "42"]


def test_a_temporary_folder_may_have_a_long_name(tmp_path: Path) -> None:
    script = (
        f"from {__name__} import _double, in_child, Path, Task\n"
        f"print(in_child('doubling', Path({str(tmp_path / 'log')!r}), '', Task(_double, (21,), 1)))\n"
    )
    folder = tmp_path / ("x" * 150)
    folder.mkdir()
    environment = {**os.environ, "TMPDIR": str(folder)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "42", done.stderr


def _has_zipapp(report: Report) -> bool:
    return "zipapp" in sys.modules


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_a_child_has_what_was_named_before_it_started(tmp_path: Path) -> None:
    script = (
        "from groundwalk.store.child import preload\n"
        "import sys\n"
        f"from {__name__} import _has_zipapp, in_child, Path, Task\n"
        "preload(*sys.argv[1:])\n"
        f"print(in_child('looking', Path({str(tmp_path / 'log')!r}), '', Task(_has_zipapp)))\n"
    )
    for modules in ([], ["zipapp"]):
        done = subprocess.run([sys.executable, "-c", script, *modules], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == str(bool(modules))


def test_an_error_in_the_child_is_raised_here(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="the setting is wrong"):
        in_child("refusing", tmp_path / "log", "", Task(_refuse))


def _meet(report: Report, mine: Path, other: Path) -> str:
    mine.touch()
    _wait_until(other.exists)
    report(1, "met")
    return mine.name


def test_tasks_run_side_by_side(tmp_path: Path) -> None:
    a, b = tmp_path / "a", tmp_path / "b"
    assert in_children("meeting", tmp_path / "log", "", [Task(_meet, (a, b), 1), Task(_meet, (b, a), 1)]) == ["a", "b"]


def test_one_error_ends_the_others(tmp_path: Path) -> None:
    written = tmp_path / "alive"
    with pytest.raises(UserError, match="the setting is wrong"):
        in_children("both", tmp_path / "log", "", [Task(_write_for_ever, (written,)), Task(_refuse)])
    _wait_until(lambda: _stands_still(written))


def test_an_aborted_child_is_an_error_with_the_end_of_its_log(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        in_child("extracting features", tmp_path / "log", "take fewer", Task(_abort, (), 3))
    assert "SIGABRT" in str(caught.value)
    assert "take fewer" in str(caught.value)
    assert "check failed: points != nullptr" in str(caught.value)


def test_the_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    written, script = tmp_path / "alive", tmp_path / "parent.py"
    script.write_text(
        f"from {__name__} import _write_for_ever, in_child, Path, Task\n"
        f"if __name__ == '__main__':\n"
        f"    task = Task(_write_for_ever, (Path({str(written)!r}),))\n"
        f"    in_child('writing', Path({str(tmp_path / 'log')!r}), '', task)\n"
    )
    parent = subprocess.Popen([sys.executable, script])
    try:
        _wait_until(written.exists)
    finally:
        parent.kill()
        parent.wait()

    _wait_until(lambda: _stands_still(written))


def _stands_still(written: Path) -> bool:
    before = written.read_text() if written.exists() else ""
    time.sleep(0.3)
    return (written.read_text() if written.exists() else "") == before


def _wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.05)
