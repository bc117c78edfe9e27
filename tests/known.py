"""What a test knows and types don't say: that a value is there, that a file is a picture, what a table's cells are; and
tables of any schema."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import pandas as pd
from numpy.typing import NDArray

from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_prefixes

T = TypeVar("T")
_PLAIN = {"float64": 0.0, "int64": 0, "bool": False, "string": "", "list<float64>": [], "list<string>": []}


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


def filled(stage: str, table: str, count: int, **columns: Any) -> pd.DataFrame:
    """A table of its schema: null where that may be, else the first choice, zero or nothing, but for columns given."""
    of = schema(stage, table)
    values = {
        c.name: [None if c.nullable else next(iter(c.choices or ()), _PLAIN[c.dtype])] * count for c in of.columns
    }
    values |= {f"{prefix}_qw": [1.0] * count for prefix in pose_prefixes(of)}
    return pd.DataFrame(values, dtype=object).assign(**columns)
