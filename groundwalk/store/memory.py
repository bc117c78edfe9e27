"""How much memory a run takes at most, with all processes that it starts; and giving back what was freed."""

import contextlib
import ctypes
import resource
import sys
import threading
from pathlib import Path

_EVERY_S = 1.0


class PeakMemory:
    """The largest memory of this process and its descendants together while the `with` block runs.

    Sampled as the proportional set size, which counts what processes share once; where the system has no /proc, the
    largest single process counts.
    """

    def __init__(self) -> None:
        self.peak_bytes = 0
        self._largest_before = _largest_process_bytes()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> "PeakMemory":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        largest = _largest_process_bytes()
        if largest > self._largest_before or self.peak_bytes == 0:  # else it was reached before the block
            self.peak_bytes = max(self.peak_bytes, largest)

    def _sample(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self.peak_bytes = max(self.peak_bytes, sum(map(_pss_bytes, _with_descendants("self"))))


def _largest_process_bytes() -> int:
    max_rss = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return max_rss * (1 if sys.platform == "darwin" else 1024)  # Linux counts kilobytes, macOS bytes


def _with_descendants(pid: str) -> list[str]:
    children: list[str] = []
    with contextlib.suppress(OSError):  # ended in between, or no /proc
        for task in Path(f"/proc/{pid}/task").iterdir():
            children += (task / "children").read_text().split()
    return [pid, *(below for child in children for below in _with_descendants(child))]


def _pss_bytes(pid: str) -> int:
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) * 1024
    return 0


def give_back_freed_memory() -> None:
    """Give the system memory that this process has freed, which glibc else keeps: of COLMAP's many small objects nearly
    all. Does nothing where the C library has no such call."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
