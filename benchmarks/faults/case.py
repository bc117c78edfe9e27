"""A fault, what is run after it, and what must hold of the outcome whatever the fault."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from numpy.random import Generator

DONE, REFUSED = 0, 2
SIGNAL_CODES = (130, 143, -2, -9, -15)
MAX_LINES = 60
_GIB = 1 << 30
_CRASH = re.compile(
    r"Traceback \(most recent call last\)|Fatal Python error|Segmentation fault|terminate called|\*\*\* SIG\w+ "
)
_ESCAPE = re.compile(r"\x1b(?!\[[0-9;?]*[a-zA-Z])")


Spoil = Callable[[Path, Generator], str]


@dataclass(frozen=True)
class Case:
    """`spoil` does the damage in a copy of a finished scene and says in words what it did; `arguments` are
    groundwalk's. `exit_codes` are those that may be; a run that ends well has outputs like the undisturbed ones'
    where `is_same`. `writes` is the stage that the command makes, if any."""

    kind: str
    name: str
    spoil: Spoil
    arguments: tuple[str, ...]
    exit_codes: tuple[int, ...] = (DONE, REFUSED)
    writes: str | None = None
    is_same: bool = False
    max_memory_bytes: int = 4 * _GIB
    before: Callable[[], None] | None = None


def differing(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Names in one of them alone, or with another state in the other."""
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))


def nothing(folder: Path, _: Generator) -> str:
    """Of a case whose fault is in its arguments, or comes later."""
    return "nothing"


@dataclass(frozen=True)
class Outcome:
    """How a command ended: its status, text, memory, and the files that it changed."""

    case: Case
    done: str
    status: int
    text: str
    peak_bytes: int
    changed: list[str] = field(default_factory=list)
    """files of other artefacts, or of this one though it was refused, or unlike those of an undisturbed run"""
    outside: list[str] = field(default_factory=list)

    @property
    def problems(self) -> list[str]:
        """What should not be, in words; empty where all promises held."""
        problems = []
        if crash := _CRASH.search(self.text):
            problems.append(f"traceback: {self.text[crash.start() :].strip().splitlines()[-1][:160]}")
        if self.status not in self.case.exit_codes:
            problems.append(f"exit status {self.status}, not one of {', '.join(map(str, self.case.exit_codes))}")
        if self.status == REFUSED and "error:" not in self.text and "Usage:" not in self.text:
            problems.append("refused without a sentence")
        if len(self.text.splitlines()) > MAX_LINES:
            problems.append(f"{len(self.text.splitlines())} lines on the screen")
        if _ESCAPE.search(self.text):
            problems.append("escape codes on the screen")
        if self.peak_bytes > self.case.max_memory_bytes:
            problems.append(f"{self.peak_bytes / _GIB:.1f} GiB of memory")
        problems += [f"changed: {name}" for name in self.changed[:3]]
        problems += [f"outside the data folder: {name}" for name in self.outside[:3]]
        return problems
