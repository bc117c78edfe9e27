"""Functions that numba compiles to machine code.

The matrices of a step are so small that each call of numpy costs more than its arithmetic does, and there are hundreds
of calls. Compiled functions work on plain numbers and arrays, and call each other. Loops over numbers compile several
times as fast as numpy's functions and expressions do, so these are hardly used in them."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def _stamp() -> str:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_STAMP = _stamp()
njit: Any = numba.njit  # its stubs lack options


def compiled(function: Function) -> Function:
    """The function, compiled at its first call. The code is kept beside the module, or in the user's cache folder
    where that can't be written; without either, each process compiles it anew."""
    try:
        dispatcher: Any = njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function)
        # numba takes kept code for current while the function's own file is; it holds functions of other files, too.
        dispatcher._cache._cache_file._source_stamp = _STAMP
    except RuntimeError:  # there is no folder
        dispatcher = njit(error_model="numpy", no_cfunc_wrapper=True)(function)
    typed: Function = dispatcher
    return typed


def inlined(function: Function) -> Function:
    """A small function for compiled ones, copied into each, so that the sizes that it is called with are constants."""
    dispatcher: Any = njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    typed: Function = dispatcher
    return typed
