"""Work in a child process: its result, its errors, its death."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from groundwalk.store import UserError, progress
from groundwalk.store.child import Report, Task, in_child, in_children
from tests.known import wait_until


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


def _count(report: Report) -> None:
    progress._LOG_EVERY_S = 0.0
    report(7)
    for _ in progress.track(range(3), "adjusting"):
        pass


def said(folder: Path, *program: object, **environment: str) -> list[str]:
    """The words that a program prints; `log` is where its tasks' output goes."""
    head = f"""
from pathlib import Path
from groundwalk.store.child import Task, in_child
from {__name__} import _double
log = Path({str(folder / "log")!r})
"""
    script = folder / "main.py"
    script.write_text(head + "\n".join(map(str, program)))
    everything = {**os.environ, **environment}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=everything)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_child_does_without_its_parents_main_module(tmp_path: Path) -> None:
    doubled = "print(in_child('doubling', log, '', Task(_double, (21,), 1)))"
    assert said(tmp_path, "print('main')", doubled) == ["main", "42"]
    long = tmp_path / ("x" * 150)  # of a temporary folder, where a socket's name would be too long
    long.mkdir()
    assert said(tmp_path, doubled, TMPDIR=str(long)) == ["42"]


def test_progress_within_a_task_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_LOG_EVERY_S", 0.0)
    in_child("mapping", tmp_path / "log", "", Task(_count, (), 8))
    assert "mapping: adjusting: 2/3 (67 %), 0 s left: 7/8 (88 %)" in capsys.readouterr().err


def test_one_error_ends_the_others(tmp_path: Path) -> None:
    written = tmp_path / "alive"
    with pytest.raises(UserError, match="the setting is wrong"):
        in_children("both", tmp_path / "log", "", [Task(_write_for_ever, (written,)), Task(_refuse)])
    wait_until(lambda: _stands_still(written))


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
        wait_until(written.exists)
    finally:
        parent.kill()
        parent.wait()

    wait_until(lambda: _stands_still(written))


def _stands_still(written: Path) -> bool:
    before = written.read_text() if written.exists() else ""
    time.sleep(0.3)
    return (written.read_text() if written.exists() else "") == before
