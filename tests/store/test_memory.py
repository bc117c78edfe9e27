"""The peak of a run's memory counts processes that run side by side together."""

import time
from pathlib import Path

import numpy as np
import pytest

from groundwalk.store.child import Report, Task, in_children
from groundwalk.store.memory import PeakMemory

_MIB = 2**20


def hold(report: Report, mib: int) -> None:
    held = np.ones(mib * _MIB, np.uint8)
    time.sleep(1)
    assert held[-1] == 1


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="this system has no /proc/self/smaps_rollup")
def test_processes_side_by_side_are_counted_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundwalk.store.memory._EVERY_S", 0.1)
    with PeakMemory() as alone:
        in_children("holding", tmp_path / "log", "", [Task(hold, (200,))])
    with PeakMemory() as together:
        in_children("holding", tmp_path / "log", "", [Task(hold, (200,)), Task(hold, (200,))])
    assert together.peak_bytes - alone.peak_bytes > 100 * _MIB
