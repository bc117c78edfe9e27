"""The capture formats: what a record of one says, and those that there are. Each module beside this one has one."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from groundwalk.capture_import.capture import Limits, RawSession
from groundwalk.store.registry import Entry, Registry, callable_faults


@dataclass(frozen=True, kw_only=True)
class Format(Entry):
    """A capture format; `meaning` says what it gives: images, video, VIO, reference poses, depth.

    `detect` says, from names alone or the first bytes of a file, whether a folder or file is one recording in this
    format; `looks_for` says the same in words. `read` gets that folder or file, the session's id and the limits; it
    raises UserError where the recording as a whole can't be read. `yields_to` names formats that are read instead where
    they fit, too, as they say more of the same images.
    """

    noun: ClassVar[str] = "capture format"

    looks_for: str
    detect: Callable[[Path], bool] = field(repr=False)
    read: Callable[[Path, str, Limits], RawSession] = field(repr=False)
    yields_to: tuple[str, ...] = ()

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["detect", "read"])


FORMATS = Registry("groundwalk.formats", Format)
