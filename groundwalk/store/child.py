"""Work in child processes: what may abort the process it runs in, and what runs side by side."""

import contextlib
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, cast

from groundwalk.store.errors import MachineError, UserError
from groundwalk.store.progress import Reporter, tell
from groundwalk.store.signals import signals_held_from_workers

_TAIL_LINES = 15
_OTHERS_ERRORS_S = 0.5
# A socket's name has at most 107 bytes, of which multiprocessing adds some 32 to the temporary folder's.
_MAX_FOLDER_BYTES = 70
# Processes are forked, from one that does nothing else. Elsewhere system libraries don't bear a fork.
_FORKS = sys.platform == "linux" and len(os.fsencode(tempfile.gettempdir())) <= _MAX_FOLDER_BYTES
_CONTEXT: ForkServerContext | SpawnContext = (
    multiprocessing.get_context("forkserver") if _FORKS else multiprocessing.get_context("spawn")
)


class Report(Protocol):
    """Says how many items are done, and perhaps how they look."""

    def __call__(self, done: int, note: str = "") -> None: ...


@dataclass(frozen=True)
class Task:
    """`function(report, *arguments)` in a process of its own.

    `function` is importable; its arguments and result can be pickled. `total` counts its items, where that is known.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    total: int | None = None


@dataclass
class _Running:
    process: multiprocessing.process.BaseProcess
    pipe: Connection
    done: int = 0
    note: str = ""
    part: str = ""
    failed: bool = False
    result: list[Any] = field(default_factory=list)


class ProcessDied(MachineError):
    """A task's process ended without a result, mostly for want of memory; `exit_code` is negative for a signal."""

    def __init__(self, what: str, *, exit_code: int | None = None, **details: Any) -> None:
        super().__init__(what, **details)
        self.exit_code = exit_code


def preload(*modules: str) -> None:
    """Name what the tasks of this process import, before the first one starts: where processes are forked, from one
    that does nothing else, it is imported there, once."""
    _CONTEXT.set_forkserver_preload(list(modules))


def in_child(text: str, log: Path, remedy: str, task: Task) -> Any:
    """The task's result; see `in_children`."""
    return in_children(text, log, remedy, [task])[0]


def in_children(text: str, log: Path, remedy: str, tasks: list[Task]) -> list[Any]:
    """The results of tasks that run side by side, under one progress; their output is appended to `log`.

    An exception in a task is raised here again. Raises UserError with the end of the log and the remedy where a process
    dies. Whatever ends this call ends every task's process, and they end with this process, so that a killed run
    leaves nothing behind that still writes.
    """
    totals = [task.total for task in tasks]
    running: list[_Running] = []
    try:
        for task in tasks:
            running.append(_start(task, log))
        with Reporter(text, None if None in totals else sum(t or 0 for t in totals)) as reporter:
            while open_ones := [r for r in running if not r.result]:
                ready = wait([r.pipe for r in open_ones])
                errors = [e for one in open_ones if one.pipe in ready if (e := _receive(one, text, log, remedy))]
                if errors:
                    # One that died, or was refused, is the reason of what those it worked with have to say.
                    errors += _errors_of_others(open_ones, text, log, remedy)
                    raise min(errors, key=lambda e: (not isinstance(e, ProcessDied), not isinstance(e, UserError)))
                notes = " · ".join(r.note for r in running if r.note)
                part = " · ".join(r.part for r in running if r.part)
                reporter.update(sum(r.done for r in running), f"{text}: {notes}" if notes else None, part)
        return [one.result[0] for one in running]
    finally:
        for one in running:
            one.process.kill()
            one.process.join()
            one.pipe.close()


def _start(task: Task, log: Path) -> _Running:
    here, there = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_work, args=(there, log, task.function, task.arguments), daemon=True)
    # Nor does SIGTERM reach them: glog, which comes with pycolmap, would print a stack.
    with _hidden_main(), signals_held_from_workers(signal.SIGTERM):
        process.start()
    there.close()
    return _Running(process, here)


@contextlib.contextmanager
def _hidden_main() -> Iterator[None]:
    """A spawned process imports its parent's main module first: a whole stage, seconds of which no task needs any."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _receive(one: _Running, text: str, log: Path, remedy: str) -> Exception | None:
    """Take in what a process says; the error where it is one, or where it died."""
    try:
        kind, value = one.pipe.recv()
    except EOFError:
        one.failed = True
        one.process.join()
        code = one.process.exitcode
        return ProcessDied(
            f"{text}: its process died ({signal.Signals(-code).name if code and code < 0 else f'exit status {code}'})",
            where=log,
            found="its last lines:\n" + _tail(log),
            do=remedy,
            exit_code=code,
        )
    if kind == "error":
        one.failed = True
        return cast(Exception, value)
    if kind == "progress":
        (one.done, one.note), one.part = value, ""
    elif kind == "part":
        one.part = value
    else:
        one.result.append(value)
    return None


def _errors_of_others(open_ones: list[_Running], text: str, log: Path, remedy: str) -> Iterator[Exception]:
    """Those of processes that fail within a moment of another one."""
    until = time.monotonic() + _OTHERS_ERRORS_S
    for one in open_ones:
        while not one.result and not one.failed and one.pipe.poll(max(0.0, until - time.monotonic())):
            if error := _receive(one, text, log, remedy):
                yield error
            if time.monotonic() > until:
                break


def _work(pipe: Connection, log: Path, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    _end_with_parent()

    def report(done: int, note: str = "") -> None:
        pipe.send(("progress", (done, note)))

    tell(lambda line: pipe.send(("part", line)))
    try:
        # Native libraries write to the process's streams, beneath Python's.
        with log.open("ab") as file:
            os.dup2(file.fileno(), sys.stdout.fileno())
            os.dup2(file.fileno(), sys.stderr.fileno())
        message = ("result", function(report, *arguments))
    except Exception as error:
        message = ("error", error)
    pipe.send(message)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    # The cause stands before the stack, which can be longer than the tail.
    messages = [line for line in lines if not line.startswith("    @ ")]
    return "\n".join(messages[-_TAIL_LINES:])
