"""Unpacking unchecked archives."""

import lzma
import shutil
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from groundwalk.capture_import.capture import Limits
from groundwalk.store import UserError
from groundwalk.store.damage import as_user_error
from groundwalk.store.errors import MachineError
from groundwalk.store.files import sync_tree

SUFFIXES = (".zip", ".r3d")
_CHUNK = 1 << 20
_MIN_FREE_BYTES = 256 << 20
# An archive may unpack to this much whatever its ratio.
_ANY_RATIO_BYTES = 100 << 20
# What the standard library raises for members that are damaged or use what it doesn't know.
_BROKEN = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, lzma.LZMAError, struct.error),
    *(NotImplementedError, RuntimeError, EOFError, OSError, ValueError),
)


def unpack(archive: Path, target: Path, limits: Limits) -> None:
    """Unpack a zip archive into the folder `target`, which appears only when all of it is there.

    UserError for an archive that is broken or encrypted, has too many files or bytes (counted while unpacking, whatever
    its headers claim; those of other archives beside `target` count too) or shrinks them more than captures do, needs
    more space than is free, or has a member that is a link or would land outside `target`.
    """
    if target.is_dir():
        return
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        with zipfile.ZipFile(archive) as content:
            members = content.infolist()
            if len(members) > limits.max_archive_files:
                raise _refused(archive, f"more than {limits.max_archive_files} files")
            needed = sum(member.file_size for member in members) + _MIN_FREE_BYTES
            free = shutil.disk_usage(partial).free
            if needed > free:
                raise MachineError(
                    f"too little free space to unpack an archive into {partial}",
                    where=archive,
                    expected=f"{needed / 2**20:,.0f} MiB",
                    found=f"{free / 2**20:,.0f} MiB free",
                    do="free some space",
                )
            others = [path for other in target.parent.iterdir() if other != target for path in other.rglob("*")]
            used = sum(path.lstat().st_size for path in others if path.is_file())
            by_ratio = _ANY_RATIO_BYTES + int(limits.max_archive_ratio * archive.stat().st_size)
            remaining = min(limits.max_archive_bytes - used, by_ratio)
            for member in members:
                place = _place(archive, partial, member)
                if member.is_dir():
                    continue
                place.parent.mkdir(parents=True, exist_ok=True)
                with content.open(member) as source, place.open("xb") as file:
                    while chunk := source.read(_CHUNK):
                        remaining -= len(chunk)
                        if remaining < 0:
                            raise _refused(archive, f"more bytes than the limit, in {member.filename!r}")
                        file.write(chunk)
    except _BROKEN as error:
        raise as_user_error(error) or UserError(
            "an archive can't be unpacked", where=archive, found=error, do="export it again"
        ) from None
    sync_tree(partial)
    partial.rename(target)


def _place(archive: Path, folder: Path, member: zipfile.ZipInfo) -> Path:
    name = PurePosixPath(member.filename.replace("\\", "/"))
    if name.is_absolute() or ".." in name.parts or any(":" in part for part in name.parts[:1]):
        raise _refused(archive, f"a member that would land outside: {member.filename!r}")
    mode = member.external_attr >> 16
    if mode and not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or stat.S_IFMT(mode) == 0):
        raise _refused(archive, f"a member that is no file or folder: {member.filename!r}")
    if member.flag_bits & 1:
        raise _refused(archive, "an encrypted member")
    return folder.joinpath(*name.parts)


def _refused(archive: Path, actual: str) -> UserError:
    return UserError("an archive is refused", where=archive, found=actual, do="unpack it yourself where you trust it")
