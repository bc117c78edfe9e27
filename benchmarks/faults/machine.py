"""A machine that gives no more: full disks, files too large, too many open files, folders that can't be written."""

import contextlib
import ctypes
import os
import resource
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.faults.case import DONE, REFUSED, Case
from benchmarks.faults.sandbox import Sandbox, stage_case
from groundwalk.cli import stages

_CLONE_NEWNS = 0x20000
_OPEN_FILES = (12, 20, 40, 80)
_DISK_BYTES = 2 << 30


def unmade(folder: Path, _: Generator, stage: str) -> str:
    """The stage's artefact is removed."""
    shutil.rmtree(Sandbox(folder).run_of(stage), ignore_errors=True)
    return f"{stage} isn't there"


def limit_file_size(size: int) -> None:
    """Before a command: no file may grow beyond so many bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def limit_open_files(count: int) -> None:
    """Before a command: so many more files at once than now."""
    now = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    resource.setrlimit(resource.RLIMIT_NOFILE, (now + count, now + count))


def can_mount() -> bool:
    """Whether this process may mount a small disk."""
    return os.geteuid() == 0 and subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode == 0


def mount_filling(stage: str, free_bytes: int, after_s: float) -> None:
    """Before a command: the scene's runs lie on a disk of their own, which some time later has so many bytes free."""
    _separate_mounts()
    runs = Sandbox(Path.cwd()).run_of(stage).parent
    aside = runs.with_name("aside")
    aside.mkdir()
    _mount("--bind", str(runs), str(aside))
    _mount("-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(runs))
    shutil.copytree(aside, runs, dirs_exist_ok=True, symlinks=True)

    def fill() -> None:
        time.sleep(after_s)
        # The command may write meanwhile, so that there is less room than there was.
        with (runs / "ballast").open("wb") as file, contextlib.suppress(OSError):
            os.posix_fallocate(file.fileno(), 0, max(1, shutil.disk_usage(runs).free - free_bytes))

    threading.Thread(target=fill, daemon=True).start()


def mount_read_only(stage: str) -> None:
    """Before a command: the scene's runs can't be written."""
    _separate_mounts()
    runs = str(Sandbox(Path.cwd()).run_of(stage).parent)
    _mount("--bind", runs, runs)
    _mount("-o", "remount,ro,bind", runs)


def mount_at(place: Path) -> None:
    """Before a command: the folder `place`, below the current one, is a mount point."""
    _separate_mounts()
    place.mkdir(exist_ok=True)
    _mount("--bind", str(place), str(place))


def _separate_mounts() -> None:
    """Mounts of this process are its own from now on, and end with it."""
    if ctypes.CDLL(None, use_errno=True).unshare(_CLONE_NEWNS):
        raise OSError(ctypes.get_errno(), "unshare")
    _mount("--make-rprivate", "/")


def _mount(*options: str) -> None:
    subprocess.run(["mount", *options], check=True, capture_output=True)


def cases(count: int) -> Iterator[Case]:
    """`count` limits a stage, of each kind in turn."""
    rng = np.random.default_rng(0)
    mounts = can_mount()
    for stage in stages():
        for number in range(count):
            size = int(10 ** rng.uniform(3, 7))
            tries = [
                (f"files of {size} bytes at most", partial(limit_file_size, size)),
                (f"{_OPEN_FILES[number % 4]} open files", partial(limit_open_files, _OPEN_FILES[number % 4])),
            ]
            if mounts:
                after_s = float(rng.choice([0.0, rng.uniform(0, 10)]))
                filling = partial(mount_filling, stage.name, size, after_s)
                tries.append((f"{size} bytes free after {after_s:.1f} s", filling))
                tries.append(("read-only", partial(mount_read_only, stage.name)))
            words, before = tries[number % len(tries)]
            missing, words = partial(unmade, stage=stage.name), f"{stage.name}, {words}"
            yield stage_case("machine", words, missing, stage.name, (DONE, REFUSED), before=before)
