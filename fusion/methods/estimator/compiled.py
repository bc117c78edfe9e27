"""Functions that numba compiles to machine code, and the small matrices that they need: products, and the inverse of
positive definite ones. Sizes are constants where they are called.

The matrices of a step are so small that each call of numpy costs more than its arithmetic does, and there are hundreds
of calls. Compiled functions work on plain numbers and arrays, and call each other. Loops over numbers compile several
times as fast as numpy's functions and expressions do, so these are hardly used in them."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array

Function = TypeVar("Function", bound=Callable[..., Any])
_njit: Any = numba.njit  # its stubs lack options
Rows = NDArray[np.void]
"""Keyframes (N,), of dtype KEYFRAME (keyframes.py)."""
Row = Any
"""One of them."""


_SOURCES = sorted(Path(__file__).parent.glob("*.py"))
_STAMP = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()


def compiled(function: Function) -> Function:
    """The function, compiled at its first call. The code is kept beside the module, or in the user's cache folder where
    that can't be written; without either, each process compiles it anew. It is current while no source of the estimator
    changes; numba by itself takes it for current while the function's own file is, though it holds functions of others.
    """
    options = {"error_model": "numpy", "no_cfunc_wrapper": True}
    try:
        dispatcher: Any = _njit(cache=True, **options)(function)
        dispatcher._cache._cache_file._source_stamp = _STAMP
    except RuntimeError:  # there is no folder
        dispatcher = _njit(**options)(function)
    typed: Function = dispatcher
    return typed


def inlined(function: Function) -> Function:
    """A small function for compiled ones, copied into each, so that the sizes that it is called with are constants."""
    dispatcher: Any = _njit(error_model="numpy", forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    typed: Function = dispatcher
    return typed


@inlined
def add_product(a: Array, b: Array, result: Array, shape: tuple[int, int, int], scale: float = 1.0) -> None:
    """Add scale * a @ b to the result: shape (n, m, p) of matrices (n, m) and (m, p)."""
    n, m, p = shape
    for i in range(n):
        for k in range(m):
            entry = scale * a[i, k]
            for j in range(p):
                result[i, j] += entry * b[k, j]


@inlined
def write_columns(matrix: Array, columns: tuple[int, ...], result: Array, rows: int) -> None:
    """Writes some columns of a matrix with so many rows."""
    for j in range(rows):
        for k in range(len(columns)):
            result[j, k] = matrix[j, columns[k]]


@inlined
def clear(matrix: Array, rows: int, columns: int) -> None:
    """Writes zeros."""
    for j in range(rows):
        for k in range(columns):
            matrix[j, k] = 0.0


@compiled
def invert(matrix: Array) -> float:
    """Invert a symmetric matrix (n, n) in its place (Gauss and Jordan); returns its determinant. GeometryError where it
    isn't positive definite."""
    n = len(matrix)
    determinant = 1.0
    for k in range(n):
        pivot = matrix[k, k]
        if not pivot > 0:
            raise GeometryError("the predictions leave the alignment undetermined: a matrix isn't positive definite")
        determinant *= pivot
        matrix[k, k] = 1.0
        for j in range(n):
            matrix[k, j] /= pivot
        for i in range(n):
            if i != k:
                rest = matrix[i, k]
                matrix[i, k] = 0.0
                for j in range(n):
                    matrix[i, j] -= rest * matrix[k, j]
    return determinant
