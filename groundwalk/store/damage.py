"""The cause of an exception: damaged checkpoints, or a machine that is out of disk, memory or files."""

import errno
import os
import resource
import shutil
import signal
from pathlib import Path

from groundwalk.store.child import ProcessDied
from groundwalk.store.errors import MachineError, UserError

_OTHER_DISK = "name a data folder on another disk with --data (judge: --out)"
_DO = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some space",
    errno.EFBIG: "raise the limit (ulimit -f unlimited)",
    errno.EROFS: "name another data folder with --data (judge: --out), or make this one writable",
    errno.EEXIST: "move it away, or name another data folder with --data (judge: --out)",
    errno.EACCES: "look at the owner and the permissions of this path and of its folder",
    errno.EMFILE: "raise the limit (ulimit -n 4096)",
    errno.ELOOP: "take the link away",
    errno.EXDEV: f"{_OTHER_DISK}: one that lies on one file system as a whole",
    errno.EBUSY: "unmount it, or end that program",
    errno.ESTALE: "see that the drive is connected, then run the same command again",
    **dict.fromkeys((errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS), _OTHER_DISK),
}
# Also what a damaged checkpoint leads to, or a fault of this program.
_MAY_BE_DAMAGE = {errno.ENOENT, errno.EISDIR, errno.EINVAL, errno.EBADF}
_OF_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FULL_BELOW_BYTES = 16 << 20
_STOPPED_FROM_OUTSIDE = {-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP}


def causes(error: BaseException | None) -> list[BaseException]:
    """An exception and what it came from, one after the other."""
    chain: list[BaseException] = []
    while error is not None and error not in chain:
        chain.append(error)
        error = error.__cause__ or error.__context__
    return chain


def as_user_error(error: BaseException, work: Path | None = None) -> MachineError | None:
    """A full disk, a read-only folder and their like; None where the machine isn't the cause.

    Libraries hide the cause: with `work`, an error without a number is the disk's if that is full there.
    """
    for cause in causes(error):
        if isinstance(cause, shutil.Error):  # without a number: of a tree, it lists every file with its error's text
            listed = cause.args[0]
            where, _, found = listed[0] if isinstance(listed, list) else (work, None, listed)
            do = next((_DO[number] for number in _DO if f"[Errno {number}]" in str(found)), None)
            return MachineError("a file can't be copied", where=where, found=found, do=do)
        if isinstance(cause, OSError) and cause.errno is not None and cause.errno not in _MAY_BE_DAMAGE:
            return sentence(cause, work)
        if isinstance(cause, MemoryError):
            do = "take smaller settings, or a machine with more memory"
            return MachineError("the memory is used up", where=work, found=str(cause) or None, do=do)
    if work is not None and isinstance(error, RuntimeError | ProcessDied | OSError) and (number := _probe(work)):
        text = str(error).split("\n")[0][:200]
        return MachineError(os.strerror(number).lower(), where=work, found=f"{_free(work)}; {text}", do=_DO.get(number))
    return None


def sentence(error: OSError, work: Path | None = None) -> MachineError:
    """An error that has a number, in words."""
    # Of a link or a rename that fails, the place where it was to be.
    name = error.filename if error.filename2 is None else error.filename2
    where = Path(os.fsdecode(name)) if isinstance(name, str | bytes | os.PathLike) else work
    room = _free(where) if error.errno in _OF_SPACE else None
    number = error.errno or 0  # the system's own words for it can be searched for
    return MachineError(os.strerror(number).lower(), where=where, found=room, do=_DO.get(number))


def may_be_damage(error: Exception) -> bool:
    """Whether a resumed run may have failed because its checkpoints are damaged: an error that neither the user nor
    the machine caused, or a process that died of itself."""
    if isinstance(error, ProcessDied):
        return error.exit_code not in _STOPPED_FROM_OUTSIDE
    return not isinstance(error, UserError | MemoryError)


def _probe(folder: Path) -> int | None:
    """The number of the error that writing into a folder gives now, if it's one of the machine's."""
    path = folder / ".probe"
    try:
        if shutil.disk_usage(folder).free < _FULL_BELOW_BYTES:
            return errno.ENOSPC
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        largest = max((file.lstat().st_size for file in folder.rglob("*")), default=0)
        if limit != resource.RLIM_INFINITY and limit - largest < _FULL_BELOW_BYTES:
            return errno.EFBIG
        path.write_bytes(b"x")
        path.unlink()
    except OSError as error:
        return None if error.errno in _MAY_BE_DAMAGE else error.errno
    return None


def free_bytes(where: Path) -> int | None:
    """Room on the disk of a path, or of what of it there is; None where that can't be told."""
    for folder in (where, *where.parents):
        try:
            return shutil.disk_usage(folder).free
        except OSError:
            continue
    return None


def _free(where: Path | None) -> str | None:
    free = None if where is None else free_bytes(where)
    return None if free is None else f"{free / 2**20:,.0f} MiB free"
