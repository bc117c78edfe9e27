"""Captures with damaged files, in every format; and archives that are made to harm."""

import gzip
import io
import shutil
import stat
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from numpy.random import Generator

from benchmarks.faults.case import Case
from benchmarks.faults.sandbox import PROFILE, SCENE, Sandbox
from tests.capture_import.capture_mutations import mutate
from tests.capture_import.capture_writers import WRITERS, make_walk

_GIB = 1 << 30
_MIB = bytes(1 << 20)
IMPORT = ("import", "--scene", SCENE, "--profile", PROFILE, "--data", "data", "--set", "check_convention=false")


def _emptied(folder: Path) -> Path:
    captures = Sandbox(folder).data.captures(SCENE)
    shutil.rmtree(captures)
    captures.mkdir()
    return captures


def _damaged(folder: Path, rng: Generator, name: str) -> str:
    captures = _emptied(folder)
    WRITERS[name].write(captures / "walk", make_walk(8))
    return ", ".join(mutate(captures, rng))


def cases(count: int) -> Iterator[Case]:
    """`count` damaged captures, the formats in turn."""
    names = list(WRITERS)
    for number in range(count):
        name = names[number % len(names)]
        spoil = partial(_damaged, name=name)
        yield Case("capture damaged", f"{name} {number}", spoil, IMPORT, writes="import", max_memory_bytes=_GIB)


def _zip(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return out.getvalue()


def _zip_of(mode: int, name: str, content: bytes) -> bytes:
    info = zipfile.ZipInfo(name)
    info.create_system, info.external_attr = 3, mode << 16
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(info, content)
    return out.getvalue()


def _tar(name: str, kind: bytes, link: str = "") -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        member = tarfile.TarInfo(name)
        member.type, member.linkname = kind, link
        archive.addfile(member)
    return out.getvalue()


def _bomb() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("log.json", "w") as member:
        for _ in range(1024):
            member.write(_MIB)
    return out.getvalue()


def _brackets() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("walk.json", "w") as member:
        member.write(b'{"pose_data":[')
        for _ in range(200):
            member.write(b"[]," * (1 << 18))
        member.write(b"[]]}")
    return out.getvalue()


def _nested() -> bytes:
    content = _zip([("a.txt", _MIB)])
    for _ in range(20):
        content = _zip([("walk.zip", content)])
    return content


def _central_lies() -> bytes:
    content = bytearray(_zip([("log.txt", _MIB)]))
    at = content.rindex(b"PK\x01\x02")
    content[at + 24 : at + 28] = b"\x01\x00\x00\x00"
    return bytes(content)


ARCHIVES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "parent": ("walk.zip", lambda: _zip([("../../../outside/diary.txt", b"x")])),
    "absolute": ("walk.zip", lambda: _zip([("/tmp/groundwalk-hacked", b"x")])),
    "backslashes": ("walk.zip", lambda: _zip([("..\\..\\outside\\diary.txt", b"x")])),
    "drive": ("walk.zip", lambda: _zip([("C:\\x", b"x")])),
    "link": ("walk.zip", lambda: _zip_of(stat.S_IFLNK | 0o777, "link", b"/etc/passwd")),
    "link to a folder": ("walk.zip", lambda: _zip_of(stat.S_IFLNK | 0o777, "walk", b"../../../outside")),
    "device": ("walk.zip", lambda: _zip_of(stat.S_IFCHR | 0o666, "zero", b"")),
    "pipe": ("walk.zip", lambda: _zip_of(stat.S_IFIFO | 0o666, "pipe", b"")),
    "setuid": ("walk.zip", lambda: _zip_of(stat.S_IFREG | 0o6777, "tool", b"#!/bin/sh")),
    "bomb": ("walk.zip", _bomb),
    "brackets": ("walk.zip", _brackets),
    "zip in zip": ("walk.zip", _nested),
    "many files": ("walk.zip", lambda: _zip([(f"{i}", b"") for i in range(70_000)], zipfile.ZIP_STORED)),
    "same name twice": ("walk.zip", lambda: _zip([("a.json", b"{}"), ("a.json", b"[]")])),
    "case collision": ("walk.zip", lambda: _zip([("A.json", b"{}"), ("a.json", b"[]")])),
    "file and folder": ("walk.zip", lambda: _zip([("a", b"{}"), ("a/b", b"[]")])),
    "long name": ("walk.zip", lambda: _zip([("x" * 300, b"")])),
    "deep": ("walk.zip", lambda: _zip([("/".join("d" * 900), b"")])),
    "control characters": ("walk.zip", lambda: _zip([("a\x1b[2Jb\n", b"")])),
    "null in name": ("walk.zip", lambda: _zip([("a\x00b", b"")])),
    "cut": ("walk.zip", lambda: _zip([("log.txt", _MIB)])[:-30]),
    "stated size wrong": ("walk.zip", _central_lies),
    "empty": ("walk.zip", lambda: b""),
    "no archive": ("walk.zip", lambda: b"hello" * 1000),
    "tar link": ("walk.tar", lambda: _tar("link", tarfile.SYMTYPE, "/etc/passwd")),
    "tar parent": ("walk.tar", lambda: _tar("../../outside/diary.txt", tarfile.REGTYPE)),
    "tar device": ("walk.tar", lambda: _tar("zero", tarfile.CHRTYPE)),
    "gzip": ("walk.tar.gz", lambda: gzip.compress(_MIB * 64)),
    "r3d": ("walk.r3d", lambda: _zip([("metadata", b"{" * 100_000)])),
}


def _archive(folder: Path, _: Generator, name: str) -> str:
    file, content = ARCHIVES[name]
    (_emptied(folder) / file).write_bytes(content())
    return name


def archive_cases() -> Iterator[Case]:
    """Every archive, imported and inspected."""
    for name, (file, _) in ARCHIVES.items():
        spoil = partial(_archive, name=name)
        yield Case("archive", f"import, {name}", spoil, IMPORT, writes="import", max_memory_bytes=_GIB)
        inspect = ("inspect", f"data/captures/{SCENE}/{file}")
        yield Case("archive", f"inspect, {name}", spoil, inspect, max_memory_bytes=_GIB)
