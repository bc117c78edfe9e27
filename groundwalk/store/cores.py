"""The machine: its processor, and how many cores there are to use."""

import contextlib
import os
import platform
import re
from pathlib import Path


def usable_cores() -> int:
    """Cores that this process may use, OMP_NUM_THREADS at most; macOS has no affinity to ask."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(limit)) if limit.isdecimal() and int(limit) else cores


def machine() -> str:
    """System, architecture, processor where Linux names it, and cores, for manifests and pages of results: training
    takes twice as long on a processor without units for products in bfloat16."""
    processor = ""
    with contextlib.suppress(OSError):
        names = re.findall(r"^model name\s*: (.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.M)
        processor = f"{names[0]}, " if names else ""
    return f"{platform.system()} {platform.machine()}, {processor}{os.cpu_count()} cores"
