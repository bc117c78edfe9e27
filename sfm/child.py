"""Running COLMAP in a child process: an error on one of its threads aborts the whole process it runs in."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from artefacts import UserError
from artefacts.progress import Reporter

P = ParamSpec("P")
R = TypeVar("R")

Report = Callable[[int], None]
"""Says how many items are done."""

_TAIL_LINES = 15


def in_child(
    function: Callable[Concatenate[Report, P], R],
    text: str,
    total: int | None,
    log: Path,
    *args: P.args,
    **kwargs: P.kwargs,
) -> R:
    """`function(report, ...)` in a process of its own, with progress; its output is appended to `log`.

    `function` is importable, its arguments and result can be pickled. An exception in it is raised here again. Raises
    UserError with the end of the log where the process dies. The process ends with this one, so that a killed run
    leaves nothing behind that still writes.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(there, log, function, args, kwargs), daemon=True)
    process.start()
    there.close()
    try:
        with Reporter(text, total) as reporter:
            while True:
                kind, value = here.recv()
                if kind == "progress":
                    reporter.update(value)
                elif kind == "error":
                    raise value
                else:
                    result: R = value
                    return result
    except EOFError:
        process.join()
        raise UserError(
            f"{text}: COLMAP's process died ({_cause(process.exitcode)})",
            where=log,
            found="its last lines:\n" + _tail(log),
            do="the same command goes on from the last safe point; too little memory needs a smaller "
            "sfm.max_image_size or sfm.max_features",
        ) from None
    finally:
        process.kill()
        process.join()
        here.close()


def _work(pipe: Connection, log: Path, function: Callable[..., Any], args: tuple, kwargs: dict) -> None:
    _end_with_parent()
    # COLMAP and its libraries write to the process's streams, beneath Python's.
    with log.open("ab") as file:
        os.dup2(file.fileno(), sys.stdout.fileno())
        os.dup2(file.fileno(), sys.stderr.fileno())
    try:
        message = ("result", function(lambda done: pipe.send(("progress", done)), *args, **kwargs))
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


def _cause(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return signal.Signals(-exit_code).name
    return f"exit status {exit_code}"


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    # The cause stands before the stack, which can be longer than the tail.
    told = [line for line in lines if not line.startswith("    @ ")]
    return "\n".join(told[-_TAIL_LINES:])
