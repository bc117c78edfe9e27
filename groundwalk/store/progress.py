"""Progress with the time left: a bar on a terminal, a line now and then in a log."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from groundwalk.store.text import printable

T = TypeVar("T")

_LOG_EVERY_S = 10.0
_TELLING = 0.02  # of the work, before which the time left is anyone's guess


class TextConsole(Console):
    """Prints text as it is, which may be a stranger's: no markup, and nothing that a terminal would act upon."""

    def print(self, *objects: Any, **options: Any) -> None:
        texts = (printable(part) if isinstance(part, str) else part for part in objects)
        super().print(*texts, **{**options, "markup": False})


console = TextConsole(stderr=True, highlight=False, soft_wrap=True)
stdout = TextConsole(highlight=False, soft_wrap=True)


def _print(line: str) -> None:
    print(f"  {line}", file=sys.stderr, flush=True)


_tell: Callable[[str], None] = _print


def tell(function: Callable[[str], None]) -> None:
    """Give this process's lines of progress to a function, which a process that works for another passes on."""
    global _tell
    _tell = function


class Reporter:
    """One task's progress: `update` it; closes with a `with` block.

    On a terminal it's a bar with the time left; elsewhere a line every ten seconds.
    """

    def __init__(self, text: str, total: int | None) -> None:
        self.text = printable(text)
        self.total = total
        self.done = 0
        self._start = self._last_line = time.monotonic()
        name, left = TextColumn("  {task.description}", markup=False), TextColumn("left")
        columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), left, TimeRemainingColumn())
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task(self.text, total=total)

    def __enter__(self) -> "Reporter":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def update(self, done: int, text: str | None = None, part: str = "") -> None:
        """Set the number of items that are done; `text` replaces the description. `part` is a line of progress of what
        goes on meanwhile, which tells the time left."""
        self.done = done
        self.text = printable(text or self.text)
        if not self._bar.disable:
            self._bar.update(self._task, completed=done, description=f"{self.text}: {part}" if part else self.text)
            return
        now = time.monotonic()
        if now - self._last_line >= _LOG_EVERY_S:
            self._last_line = now
            _tell(f"{self.text}: {part}: {self._count()}" if part else f"{self.text}: {self._summary(now)}")

    def _count(self) -> str:
        if not self.total:
            return f"{self.done} done"
        return f"{self.done}/{self.total}" + f" ({100 * self.done / self.total:.0f} %)" * (self.done > 0)

    def _summary(self, now: float) -> str:
        if not self.total or self.done < max(1, _TELLING * self.total) or self.done == self.total:
            return self._count()
        left = (now - self._start) / self.done * (self.total - self.done)
        return f"{self._count()}, {format_seconds(left)} left"


def track(items: Iterable[T], text: str, total: int | None = None) -> Iterator[T]:
    """Yield the items, showing progress; `total` where `items` has no length."""
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    with Reporter(text, total) as reporter:
        for done, item in enumerate(items, start=1):
            yield item
            reporter.update(done)


def format_seconds(seconds: float) -> str:
    """A duration as a person says it: 8 s, 2 min 05 s, 1 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
