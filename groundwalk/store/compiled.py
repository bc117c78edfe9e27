"""Functions that numba compiles to machine code."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])
njit: Any = numba.njit  # its stubs lack options


def compiled_and_kept(function: Function, stamp: str | None = None, **options: Any) -> Function:
    """The function, compiled at its first call by numba's options. The code is kept beside the module, or in the user's
    cache folder where that can't be written; without either, each process compiles it anew.

    numba takes kept code for current while the function's own file is; where it holds functions of other files, too,
    `stamp` says which sources it is of.
    """
    try:
        dispatcher: Any = njit(cache=True, **options)(function)
        if stamp is not None:
            dispatcher._cache._cache_file._source_stamp = stamp
    except RuntimeError:  # there is no folder
        dispatcher = njit(**options)(function)
    typed: Function = dispatcher
    return typed
