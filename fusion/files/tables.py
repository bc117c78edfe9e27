"""`python -m groundwalk.fusion evaluate` and `sweep`: on three Parquet tables from anywhere."""

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from groundwalk.fusion.evaluation.evaluate import (
    FuseSettings,
    Inputs,
    evaluate,
    joined_walks,
    report_lines,
    rule_options,
)
from groundwalk.fusion.evaluation.sweep import around, grid, sweep
from groundwalk.fusion.evaluation.sweep_figure import write_sweep_figure
from groundwalk.fusion.recording import blueprint, record
from groundwalk.fusion.walk import with_odometry
from groundwalk.store import DataRoot, UserError
from groundwalk.store.files import RECORDING, file_names, fresh_folder, refuse_to_overwrite, write_json
from groundwalk.store.progress import console
from groundwalk.store.recording import open_recording
from groundwalk.store.schemas import schema
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings
from groundwalk.store.tables import dataset_frames, write_table

_NOTE = "evaluation.json"


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


def evaluate_files(files: Files, out: Path, scene: str, overrides: list[str], force: bool = False) -> None:
    """Evaluate the three tables and write the fuse stage's tables and recording to the folder `out`, which appears when
    it is whole.

    Frames without a column `split` are all evaluated. UserError for whatever the tables have that can't be evaluated,
    and where `out` is there; with `force` earlier results in it are replaced, nothing else ever is.
    """
    settings = _settings(scene, overrides)
    with _written(out, force) as folder:
        results = evaluate([files.read(scene)], settings)
        for name, table in results.tables.items():
            write_table(folder / f"{name}.parquet", table, schema("fuse", name))
        with open_recording(folder / RECORDING, "fuse", scene, blueprint(results.fused, results.gates)) as stream:
            record(stream, results.fused, results.gates)
        _write_note(folder, files, scene, settings, dict(results.counts))
    for line in report_lines(results):
        console.print(line)


def sweep_files(
    files: Files, out: Path, scene: str, overrides: list[str], every: bool, processes: int, force: bool = False
) -> None:
    """Run the paper's rule over the three tables with other thresholds, one at a time or (`every`) in all combinations
    too; write sweep.parquet and sweep.svg to the folder `out`, as `evaluate_files` does."""
    settings = _settings(scene, overrides)
    options = rule_options(settings)
    chosen = around(options) + (grid(options) if every else [])
    with _written(out, force) as folder:
        joined = joined_walks(files.read(scene), settings.splits)
        walks = {(scene, model): on for model, of_model in joined if (on := with_odometry(of_model.walks))}
        if not walks:
            raise UserError("nothing can be fused: no frame has a pose by odometry", where=files.frames)
        table = sweep(walks, chosen, min(processes, len(walks)))
        write_table(folder / "sweep.parquet", table, schema("fuse", "sweep"))
        write_sweep_figure(table, options.model_dump(), folder / "sweep.svg")
        _write_note(folder, files, scene, settings, {})
    console.print(f"{len(chosen)} settings: {out / 'sweep.parquet'}, {out / 'sweep.svg'}")


@contextlib.contextmanager
def _written(out: Path, force: bool) -> Iterator[Path]:
    """A folder beside `out` to write into; it becomes `out` when the block ends well, and is dropped otherwise."""
    out = out.absolute()
    try:
        refuse_to_overwrite(out, "results", _NOTE, "inputs", force=force)
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError("the output folder can't be made", where=out, found=error.strerror) from None
    try:
        with fresh_folder(out) as folder:
            yield folder
    except OSError as error:
        raise UserError("the results can't be written", where=error.filename or out, found=error.strerror) from None


def _write_note(folder: Path, files: Files, scene: str, settings: FuseSettings, counts: dict[str, int]) -> None:
    """What the results were made of, and which files they are; written last."""
    inputs = {
        name: {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
        for name, path in asdict(files).items()
    }
    note = {"scene": scene, "inputs": inputs, "settings": settings.model_dump(mode="json"), "counts": counts}
    write_json(folder / _NOTE, {**note, "files": file_names(folder)})


def _settings(scene: str, overrides: list[str]) -> FuseSettings:
    return resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", scene, overrides)


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
