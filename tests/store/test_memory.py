"""The peak of a run's memory counts processes that run side by side together."""

import time
from pathlib import Path

import numpy as np
import pytest

from groundwalk.store.child import Report, Task, in_children
from groundwalk.store.memory import PeakMemory

_MIB = 2**20


@pytest.fixture(autouse=True)
def frequent_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundwalk.store.memory._EVERY_S", 0.1)


def hold(report: Report, folder: Path, index: int, n_together: int) -> None:
    """Holds 200 MiB until all tasks of this folder do, and a second longer."""
    held = np.ones(200 * _MIB, np.uint8)
    (folder / str(index)).touch()
    ends = time.monotonic() + 60
    while len(list(folder.iterdir())) < n_together:
        assert time.monotonic() < ends
        time.sleep(0.05)
    time.sleep(1)
    assert held[-1] == 1


def peak_bytes(folder: Path, n_together: int) -> int:
    folder.mkdir()
    with PeakMemory() as peak:
        tasks = [Task(hold, (folder, index, n_together)) for index in range(n_together)]
        in_children("holding", folder.with_suffix(".log"), "", tasks)
    return peak.peak_bytes


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="this system has no /proc/self/smaps_rollup")
def test_processes_side_by_side_are_counted_together(tmp_path: Path) -> None:
    assert 100 * _MIB < peak_bytes(tmp_path / "two", 2) - peak_bytes(tmp_path / "one", 1) < 400 * _MIB


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="this system has no /proc/self/smaps_rollup")
def test_memory_freed_before_the_run_is_not_counted(tmp_path: Path) -> None:
    before = np.ones(1000 * _MIB, np.uint8)
    with_it = peak_bytes(tmp_path / "held", 1)
    assert before[-1] == 1
    del before
    assert with_it - peak_bytes(tmp_path / "freed", 1) > 700 * _MIB
