"""Unpacking archives that nobody has checked."""

import shutil
import stat
import zipfile
from pathlib import Path, PurePosixPath

from artefacts import UserError
from capture_import.capture import Limits

SUFFIXES = (".zip", ".r3d")
_CHUNK = 1 << 20


def unpack(archive: Path, target: Path, limits: Limits) -> None:
    """Unpack a zip archive into the folder `target`, which appears only when all of it is there.

    UserError for an archive that is broken or encrypted, has too many files or bytes (counted while unpacking, whatever
    its headers claim), or a member that is a link or would land outside `target`.
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
            left = limits.max_archive_bytes
            for member in members:
                place = _place(archive, partial, member)
                if not member.is_dir():
                    left -= _extract(archive, content, member, place, left)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, EOFError, OSError, ValueError) as error:
        raise UserError("an archive can't be unpacked", where=archive, found=error, do="export it again") from None
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


def _extract(archive: Path, content: zipfile.ZipFile, member: zipfile.ZipInfo, place: Path, left: int) -> int:
    """Write one member; returns its bytes."""
    place.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with content.open(member) as source, place.open("xb") as target:
        while chunk := source.read(_CHUNK):
            size += len(chunk)
            if size > left:
                raise _refused(archive, "more bytes than the limit")
            target.write(chunk)
    return size


def _refused(archive: Path, found: str) -> UserError:
    return UserError("an archive is refused", where=archive, found=found, do="unpack it yourself where you trust it")
