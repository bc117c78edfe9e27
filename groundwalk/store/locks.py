"""Locks between processes: who makes an artefact has it alone; who reads it keeps it from being replaced."""

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from groundwalk.store.errors import UserError

_ATTEMPTS = 100  # others that make and remove the lock's file again and again


def lock_file(folder: Path) -> Path:
    """The lock file of a folder: beside it, so that the folder can be replaced and removed."""
    return folder.with_name(f".{folder.name}.lock")


@contextlib.contextmanager
def locked(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Hold the lock of a folder that need not exist: exclusive to write or remove it, `shared` to read it.

    Raises UserError at once where another process holds the lock in a way that excludes this one. The lock ends with
    this process, however that ends.
    """
    path = lock_file(folder)
    for _ in range(_ATTEMPTS):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
        except FileNotFoundError:  # the parent was removed in between
            continue
        try:
            try:
                fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                doing = "is being made or removed" if shared else "is being made, read or removed"
                raise UserError(
                    f"{folder.name} {doing} by another run that is under way",
                    where=folder,
                    do="wait for it to end, or stop it",
                ) from None
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from None
            # Who held the lock before may have removed its file: a lock on a removed file excludes nobody.
            if not _is_same_file(descriptor, path):
                continue
            yield
            return
        finally:
            os.close(descriptor)
    raise UserError(
        f"{folder.name} can't be locked",
        where=path,
        found="its lock file isn't the one that was opened",
        do="name a data folder on another disk with --data",
    )


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
