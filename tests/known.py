"""What a test knows and types don't say: that a value is there, that a file is a picture, what a table's cells are;
tables of any schema, and those of a run of profile tiny; import's frames as of images alone."""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.store.files import write_json
from groundwalk.store.manifests import load_manifest, output_hashes
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import pose_prefixes, read_table, write_table

T = TypeVar("T")
_PLAIN = {"float64": 0.0, "int64": 0, "bool": False, "string": "", "list<float64>": [], "list<string>": []}


def there(value: T | None) -> T:
    assert value is not None
    return value


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.02)


def written(path: Path, text: str) -> Path:
    """A new text file, in folders that are made where they aren't there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


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


def table_of(data: DataRoot, scene: str, stage: str, table: str) -> pd.DataFrame:
    return read_table(data.run("tiny", scene, stage) / f"{table}.parquet", schema(stage, table))


def put(data: DataRoot, scene: str, stage: str, table: str, content: pd.DataFrame) -> None:
    """Write a table where its stage would have, whatever the manifest says of it."""
    write_table(data.run("tiny", scene, stage) / f"{table}.parquet", content, schema(stage, table))


def rewrite(data: DataRoot, scene: str, stage: str, table: str, content: pd.DataFrame) -> None:
    """Put another content into a table, as its stage would have written it."""
    put(data, scene, stage, table, content)
    note_outputs(data.run("tiny", scene, stage))


def note_outputs(folder: Path, **more: object) -> None:
    """Have a manifest say that the stage wrote what is there now, and more."""
    write_json(folder / "manifest.json", load_manifest(folder) | {"outputs": output_hashes(folder)} | more)


def without_vio(frames: pd.DataFrame) -> pd.DataFrame:
    """import.frames as of images alone: without VIO's poses and gravity."""
    return frames.assign(**{c: np.nan for c in frames.columns if c.startswith(("vio_cam_", "gravity_"))})
