"""Files that are whole or not there: written aside, synced to the disk, then renamed; and their hashes."""

import contextlib
import errno
import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from groundwalk.store.errors import UserError
from groundwalk.store.text import name_list

KEY_FILE = "key.json"
CHANGE = "change"
"""In a scene's run: the partial folder of this name is that of recordings being added or removed."""
RECORDING = "recording.rrd"
STOPPED = "stopped.json"
"""In a partial folder: why the stage found no result there, for the report."""
_digests: dict[tuple[str | int, ...], str] = {}
_WITHOUT_THREADS = 1 << 24  # bytes that are hashed in less time than threads take to start
_SETTLED_NS = 2 * 10**9  # the coarsest clock of a file system: what is younger may be written again without a trace
IMPORTED = "import:"
"""In front of the path of an image that import copied, which is relative to the import artefact."""


def leads_outside(name: str) -> bool:
    """Whether a path that others wrote, in a table, manifest or capture, isn't in the folder that it's relative to;
    IMPORTED in front stands for one."""
    path = PurePosixPath(name.removeprefix(IMPORTED))
    return path.is_absolute() or ".." in path.parts or "\0" in name


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Where to write a file that becomes `path`, synced, when the block ends well: after a kill or power cut either it
    or the one before is there, whole."""
    partial = path.with_name(path.name + ".partial")
    partial.unlink(missing_ok=True)
    yield partial
    _sync(partial)
    partial.replace(path)
    _sync(path.parent)


def read_json(path: Path, max_bytes: int = 64 << 20) -> dict[str, Any]:
    """The object in a JSON file, {} where there is none that can be read, or one larger than any manifest."""
    try:
        with path.open("rb") as file:
            text = file.read(max_bytes + 1)
        content = json.loads(text) if len(text) <= max_bytes else None
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def write_json(path: Path, content: object) -> None:
    """Write JSON atomically."""
    with written_aside(path) as partial:
        partial.write_text(json.dumps(content, indent=2, allow_nan=False, default=str) + "\n", encoding="utf-8")


def file_names(folder: Path) -> list[str]:
    """All files of a folder, and links, which aren't followed, by their paths in it."""
    paths = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def refuse_to_overwrite(out: Path, results: str, note: str, key: str, *, force: bool) -> None:
    """UserError where the folder `out` holds anything but earlier results, whose file `note` has `key` and, as `files`,
    the names of all others; or these, unless `force`d."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    content = read_json(out / note)
    if key in content and not force:
        raise UserError(
            f"the output folder holds earlier {results}", where=out, do="name another folder, or use --force"
        )
    listed = content.get("files", [])
    others = sorted({*file_names(out)} - {note, *(map(str, listed) if isinstance(listed, list | dict) else ())})
    if others or key not in content:
        raise UserError(
            f"the output folder holds other files than earlier {results}",
            where=out,
            expected=f"a new or empty folder, or earlier {results}: their {note}, and the files that it lists",
            found=name_list(others, 3),
            do="move them away, or name another folder with --out",
        )


def make_writable(folder: Path) -> None:
    """Make a folder before long work. UserError where it can't be made, or no file can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError("nothing can be written there", where=folder, found=error.strerror) from None


def link_or_copy(source: Path | str, target: Path | str) -> None:
    """A second name of a file, or a copy where there can be none: on another disk, or one without links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def hash_files(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """sha256 of files by their path relative to `folder`."""
    paths = sorted(files)
    if sum(path.stat().st_size for path in paths) < _WITHOUT_THREADS:
        return {path.relative_to(folder).as_posix(): sha256_of(path) for path in paths}
    with ThreadPoolExecutor() as pool:
        digests = pool.map(sha256_of, paths)
        return {path.relative_to(folder).as_posix(): digest for path, digest in zip(paths, digests, strict=True)}


def sha256_of(path: Path) -> str:
    """The sha256 of a file in hexadecimal digits; one that this process has hashed is read again where it has changed
    since, by its inode, size and times."""
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        state = (status.st_dev, *_state(str(path), status))
        digest = _digests.get(state) or hashlib.file_digest(file, "sha256").hexdigest()
    if _is_settled(status):
        _digests[state] = digest
    return digest


def state_of_files(files: Iterable[str]) -> str | None:
    """A digest of names, inodes, sizes and times of files, as long as which is the same nothing was written to them;
    None while one is so young that it may be written again without a trace, and where one can't be read."""
    state, are_settled = hashlib.sha256(), True
    for path in files:
        try:
            status = os.stat(path)  # noqa: PTH116 - a Path takes four times as long
        except OSError:
            return None
        are_settled &= _is_settled(status)
        state.update(repr(_state(path, status)).encode())
    return state.hexdigest() if are_settled else None


def _state(path: str, status: os.stat_result) -> tuple[str | int, ...]:
    return (path, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def _is_settled(status: os.stat_result) -> bool:
    """Whether another content would show in the file's times."""
    return time.time_ns() - max(status.st_mtime_ns, status.st_ctime_ns) > _SETTLED_NS


def partial_folder(final: Path) -> Path:
    """Where a run writes until it ends: beside the folder that it becomes."""
    return final.with_name(f".{final.name}.partial")


def old_folder(final: Path) -> Path:
    """Where a replaced folder is between the two renames of `swap_in`."""
    return final.with_name(f".{final.name}.old")


def refuse_irreplaceable(final: Path) -> None:
    """UserError where a folder can't be put in a place: better now than after the work."""
    if not os.path.lexists(final) or (final.is_dir() and not final.is_symlink() and not final.is_mount()):
        return
    obstacle = "a link" if final.is_symlink() else "a disk of its own" if final.is_dir() else "a file"
    raise UserError(
        f"{final.name} is replaced as a whole, and what is there can't be",
        where=final,
        expected="a folder, or nothing",
        found=obstacle,
        do="move it away; to have results on another disk, link or mount a folder above it, or name another one",
    )


def swap_in(work: Path, final: Path, made: Callable[[Path], Collection[str]]) -> None:
    """Put a finished folder in its place, synced; a kill between the two renames is mended by the next run.

    `made` lists which files of such a folder this program wrote. Others that are in the replaced one go to the new one.
    """
    (work / KEY_FILE).unlink(missing_ok=True)
    sync_tree(work)
    if final.exists():
        _drop_old(final, made)
        final.rename(old_folder(final))
    work.rename(final)
    _sync(final.parent)
    _drop_old(final, made)


def finish_interrupted_swap(final: Path, last: str, made: Callable[[Path], Collection[str]]) -> None:
    """What a `swap_in` that was killed left undone; `last` is the file that a finished folder gets last."""
    work, old = partial_folder(final), old_folder(final)
    if read_json(work / last):
        refuse_irreplaceable(final)
        swap_in(work, final, made)
    elif old.is_dir() and not old.is_symlink() and not os.path.lexists(final):
        old.rename(final)
    _drop_old(final, made)


def _drop_old(final: Path, made: Callable[[Path], Collection[str]]) -> None:
    old = old_folder(final)
    if old.is_symlink():
        old.unlink()
    elif old.is_dir():
        # Where its own list is damaged, what the new one has is taken for its files.
        _move_others(old, final, made(old) or made(final))
        shutil.rmtree(old, ignore_errors=True)


def _move_others(source: Path, target: Path, made: Collection[str]) -> None:
    """Move the files of a folder that aren't listed to the same places in another one, which keeps what it has."""
    for name in file_names(source):
        if name not in made:
            place = target / name
            with contextlib.suppress(FileExistsError, NotADirectoryError):
                place.parent.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(place) or not place.parent.is_dir():
                place = target / f"{name.replace('/', '-')}.kept"
            (source / name).rename(place)


@contextlib.contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """A folder that becomes `out` when the block ends well, in place of what is there; nothing else is touched.

    It's made under a name that nothing beside `out` has, and dropped where the block fails. Files that came to `out`
    meanwhile are kept. UserError where it's no folder; a link is followed.
    """
    out = out.resolve()
    refuse_irreplaceable(out)
    before = file_names(out)
    aside = Path(tempfile.mkdtemp(prefix=".groundwalk-", dir=out.parent))
    work, old = aside / "new", aside / "old"
    try:
        work.mkdir()
        yield work
        sync_tree(work)
        if out.exists():
            out.rename(old)
        work.rename(out)
        _sync(out.parent)
    finally:
        if old.exists() and out.exists():
            _move_others(old, out, before)
        elif old.exists():
            old.rename(out)
        shutil.rmtree(aside, ignore_errors=True)


def sync_tree(folder: Path) -> None:
    """Have every file and folder of a tree on the disk, so that a rename can't come before its content."""
    paths = [Path(base) / name for base, _, names in os.walk(folder) for name in (*names, ".")]
    with ThreadPoolExecutor() as pool:  # a disk writes many files at once sooner than one after the other
        list(pool.map(_sync, [path for path in paths if path.is_dir() or (path.is_file() and not path.is_symlink())]))


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some network drives sync files alone, and what becomes of a folder's names is theirs.
        if not (path.is_dir() and error.errno in (errno.EINVAL, errno.EBADF)):
            raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        os.close(descriptor)
