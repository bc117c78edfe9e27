"""Ctrl-C and SIGTERM as one exception, and processes that leave both to their parent."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Stopped(BaseException):
    """A signal asked this process to end; no Exception, so that no handler of errors takes it for one.

    again: what becomes of what was made so far, where the same command is run again; empty where it's lost.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number
        self.again = ""


@contextlib.contextmanager
def signals_raise() -> Iterator[None]:
    """Raise Stopped where a signal asks this process to end; for the main thread."""
    before = {number: signal.signal(number, _raise) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def handlers_kept() -> Iterator[None]:
    """Python's handler of SIGTERM is again there when the block ends, which loads modules: glog, which comes with
    pycolmap, puts one of its own there, that prints a stack and ends the process. SIGTERM waits until then, where the
    main thread gets it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_held(*more: signal.Signals) -> Iterator[None]:
    """Processes that are started in the block never get Ctrl-C, as a terminal sends it to them too, nor the signals
    that are named: their parent ends them. This process gets these when the block ends."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *more})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def signals_held_from_workers(*more: signal.Signals) -> Iterator[None]:
    """The same of multiprocessing's processes, whose tracker, begun with the first, would let Ctrl-C through again."""
    resource_tracker.ensure_running()
    with signals_held(*more):
        yield


def _raise(number: int, _: FrameType | None) -> None:
    raise Stopped(number)
