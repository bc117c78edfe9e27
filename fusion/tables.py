"""`python -m fusion evaluate`: the stage's evaluation on three Parquet tables from anywhere."""

from pathlib import Path

import pandas as pd
import pyarrow as pa

from artefacts import DataRoot, UserError
from artefacts.progress import console
from artefacts.recording import RECORDING, open_recording
from artefacts.schemas import schema
from artefacts.settings import SHIPPED_DATA, resolve_settings
from artefacts.tables import write_table
from fusion.evaluate import FuseSettings, Inputs, evaluate, report_lines
from fusion.record import blueprint, record


def evaluate_files(
    frames: Path, ground_truth: Path, predictions: Path, out: Path, scene: str, overrides: list[str]
) -> None:
    """Evaluate the three tables and write the fuse stage's tables and recording to `out`.

    Frames without a column `split` are all evaluated. UserError for whatever the tables have that can't be evaluated.
    """
    settings = resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", scene, overrides)
    frame_table = _read(frames)
    if "split" not in frame_table.columns:
        frame_table = frame_table.assign(split="test")
    results = evaluate([Inputs(scene, frame_table, _read(ground_truth), _read(predictions))], settings)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError("the output folder can't be made", where=out, found=error) from None
    for name, table in results.tables.items():
        write_table(out / f"{name}.parquet", table, schema("fuse", name))
    with open_recording(out / RECORDING, "fuse", scene, blueprint(results.fused)) as stream:
        record(stream, results.fused, results.gates)
    for line in report_lines(results):
        console.print(line, markup=False)


def _read(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise UserError("there is no such table", where=path, expected="a Parquet file")
    try:
        return pd.read_parquet(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise UserError("a table can't be read", where=path, found=error, expected="a Parquet file") from None
