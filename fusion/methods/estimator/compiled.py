"""Functions that numba compiles to machine code.

The matrices of a step are so small that each call of numpy costs more than its arithmetic does, and there are hundreds
of calls. Compiled functions work on plain numbers and arrays, and call each other. Loops over numbers compile several
times as fast as numpy's functions and expressions do, so these are hardly used in them."""

import hashlib
from pathlib import Path
from typing import Any

from groundwalk.store.compiled import Function, compiled_and_kept, njit


def _stamp() -> str:
    sources = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


_STAMP = _stamp()


def compiled(function: Function) -> Function:
    """The function, compiled at its first call, and kept while no source of the estimator changes."""
    return compiled_and_kept(function, _STAMP, error_model="numpy", no_cfunc_wrapper=True)


def inlined(function: Function) -> Function:
    """A small function for compiled ones, copied into each, so that the sizes that it is called with are constants."""
    dispatcher: Any = njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    typed: Function = dispatcher
    return typed
