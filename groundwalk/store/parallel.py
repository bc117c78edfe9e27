"""Work on all cores for what releases Python's lock, decoding and OpenCV; products of small matrices on one thread."""

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import cv2
from threadpoolctl import ThreadpoolController

from groundwalk.store.cores import usable_cores

T = TypeVar("T")
R = TypeVar("R")

# Results that may wait for the consumer, a worker: enough that no core idles, few enough that memory stays flat.
_AHEAD = 4


def in_parallel(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """`function` of each item, in order, on as many threads as there are cores that this process may use; a few items
    are worked on ahead."""
    workers = usable_cores()
    pending: deque[Future[R]] = deque()
    with single_threaded_opencv(), ThreadPoolExecutor(workers) as pool:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) > _AHEAD * workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


@contextlib.contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """OpenCV's calls on one thread each: with small images, threads only get in each other's way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


_controller = cache(ThreadpoolController)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Matrix products within are computed on one thread: with small matrices, threads only get in each other's way."""
    with _controller().limit(limits=1, user_api="blas"):
        yield
