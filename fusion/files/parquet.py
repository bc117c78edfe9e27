"""One scene's three tables as Parquet files."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from groundwalk.fusion.files.walks import Inputs
from groundwalk.store import UserError
from groundwalk.store.tables import dataset_frames


@dataclass(frozen=True)
class Files:
    """The three tables of one scene, as Parquet."""

    frames: Path
    ground_truth: Path
    predictions: Path

    def read(self, scene: str) -> Inputs:
        """UserError where a file isn't a Parquet table."""
        frames = _read(self.frames)
        if "split" not in frames.columns:
            frames = frames.assign(split="test")
        if "support" in frames.columns:
            frames = dataset_frames(frames)
        return Inputs(scene, frames, _read(self.ground_truth), _read(self.predictions))


def _read(path: Path) -> pd.DataFrame:
    """A Parquet table; UserError where there is none."""
    if not path.is_file():
        actual = "a folder" if path.is_dir() else None
        raise UserError("there is no such table", where=path, expected="a Parquet file", found=actual)
    try:
        table = pq.read_table(path)
        # A table whose frames are pandas' index has them as columns again.
        frame: pd.DataFrame = table.to_pandas(ignore_metadata=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UserError("a table can't be read", where=path, found=error, expected="a Parquet file") from None
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise UserError("a table has a column twice", where=path, found=twice[0])
    # Dictionaries of texts are texts.
    return frame.astype(dict.fromkeys(frame.select_dtypes("category").columns, object))
