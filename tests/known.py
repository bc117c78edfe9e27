"""What a test knows and types don't say: that a value is there, that a file is a picture, what a table's cells are."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import pandas as pd
from numpy.typing import NDArray

T = TypeVar("T")


def there(value: T | None) -> T:
    assert value is not None
    return value


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """OpenCV's reading of a picture, which is None of one that it can't read."""
    return there(cv2.imread(str(path), flags))


def cells(values: Iterable[object]) -> list[Any]:
    """A column of lists or of None; the stubs take scalars only."""
    return list(values)


def rows(table: pd.DataFrame) -> Iterator[Any]:
    """`itertuples`, with the columns' own types: the stubs have a union of every scalar, whatever the column."""
    return table.itertuples()


def cell(table: pd.DataFrame, row: Any, column: str) -> Any:
    """`table.loc[row, column]` of an index without repetition, likewise."""
    return table.loc[row, column]
