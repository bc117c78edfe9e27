"""The capture formats: what a record of one says, and those that there are. Each module beside this one has one."""

import fnmatch
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from groundwalk.capture_import.capture import Limits, Recording
from groundwalk.store.registry import Entry, Registry, callable_faults
from groundwalk.store.text import in_words


@dataclass(frozen=True, kw_only=True)
class Format(Entry):
    """A capture format; `meaning` says what it gives: images, video, VIO, reference poses, depth.

    `files` are the names, relative to a recording's folder, by which it is known: all of them have to be there; `*` in
    one stands for any text, `a|b` for either, `/` at the end for a folder. Where `is_file`, a recording is one file of
    such a name instead. Where these names don't tell, `detect` says whether a folder or file is a recording, and
    `looks_for` the same in words; `missing` says what a folder with some of `files` lacks, nothing where that isn't
    known. `read` gets that folder or file and the limits; it raises UserError where the recording as a whole can't be
    read. `yields_to` names formats that are read instead where they fit, too, as they say more of the same images;
    `yields_to_all`: all others that don't yield to all, as poses that were made of a recording's images lie beside its
    own. `is_images_alone`: it has no poses, and is looked for where a capture holds nothing else that could, or where
    it's named.
    """

    noun: ClassVar[str] = "capture format"

    files: tuple[str, ...]
    read: Callable[[Path, Limits], Recording] = field(repr=False)
    is_file: bool = False
    is_images_alone: bool = False
    detect: Callable[[Path], bool] | None = field(default=None, repr=False)
    missing: Callable[[Path], str] | None = field(default=None, repr=False)
    looks_for: str = ""
    yields_to: tuple[str, ...] = ()
    yields_to_all: bool = False

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        given = [name for name in ("detect", "missing") if getattr(self, name) is not None]
        yield from callable_faults(self, ["read", *given])
        if not isinstance(self.files, tuple) or not all(isinstance(name, str) for name in self.files):
            yield f"files is {self.files!r}, not names"

    @property
    def recognised_by(self) -> str:
        """How a recording is known, in words."""
        return self.looks_for or in_words(name.replace("|", " or ") for name in self.files)

    def fits(self, path: Path) -> bool:
        """Whether a folder or file is one recording in this format."""
        return self.detect(path) if self.detect is not None else all(self.has(path))

    def has(self, path: Path) -> list[bool]:
        """Which of `files` a folder has, or whether a file's name is one."""
        if self.is_file:
            return [path.is_file() and fnmatch.fnmatchcase(path.name, name) for name in self.files]
        return [any(is_in(path, name) for name in names.split("|")) for names in self.files]


def is_in(folder: Path, name: str) -> bool:
    """Whether a folder has a name of `Format.files`, without alternatives."""
    if "*" in name:
        return any(True for _ in folder.glob(name))
    return (folder / name).is_dir() if name.endswith("/") else (folder / name).is_file()


FORMATS = Registry("groundwalk.formats", Format)
