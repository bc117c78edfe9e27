"""Small matrices: products, and the inverse of positive definite ones. Sizes are constants where they are called."""

from groundwalk.fusion.methods.estimator.compiled import compiled, inlined
from groundwalk.geometry.poses import Array


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
    """Invert a symmetric matrix (n, n) in its place (Gauss and Jordan); returns its determinant, or 0 where it isn't
    positive definite."""
    n = len(matrix)
    determinant = 1.0
    for k in range(n):
        pivot = matrix[k, k]
        if not pivot > 0:
            return 0.0
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
