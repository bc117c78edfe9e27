"""Queries' matrices are small: on several threads a product takes longer and, of all cores, several times as much."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Matrix products within are computed on one thread."""
    with _controller().limit(limits=1, user_api="blas"):
        yield
