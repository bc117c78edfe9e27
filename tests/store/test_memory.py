"""The peak of a run's memory counts processes that run side by side together, and nothing that was freed before."""

import time
from pathlib import Path

import numpy as np
import pytest

from groundwalk.store.child import Report, Task, in_children
from groundwalk.store.memory import PeakMemory
from tests.known import wait_until

_MIB = 2**20


def hold(report: Report, folder: Path, index: int, n_together: int) -> None:
    """Holds 200 MiB until all tasks of this folder do, and a second longer."""
    held = np.ones(200 * _MIB, np.uint8)
    (folder / str(index)).touch()
    wait_until(lambda: len(list(folder.iterdir())) == n_together)
    time.sleep(1)
    assert held[-1] == 1


def peak_bytes(folder: Path, n_together: int) -> int:
    folder.mkdir()
    with PeakMemory() as peak:
        tasks = [Task(hold, (folder, index, n_together)) for index in range(n_together)]
        in_children("holding", folder.with_suffix(".log"), "", tasks)
    return peak.peak_bytes


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="this system has no /proc/self/smaps_rollup")
def test_what_processes_have_together_while_it_runs_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundwalk.store.memory._EVERY_S", 0.1)
    before = np.ones(1000 * _MIB, np.uint8)
    held = peak_bytes(tmp_path / "held", 1)
    assert before[-1] == 1
    del before
    one = peak_bytes(tmp_path / "one", 1)
    assert held - one > 700 * _MIB
    assert 100 * _MIB < peak_bytes(tmp_path / "two", 2) - one < 400 * _MIB
