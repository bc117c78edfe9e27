"""`python -m fusion evaluate` and `sweep`: on three Parquet tables from anywhere."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import pyarrow as pa

from artefacts import DataRoot, UserError
from artefacts.progress import console
from artefacts.recording import RECORDING, open_recording
from artefacts.schemas import schema
from artefacts.settings import SHIPPED_DATA, resolve_settings
from artefacts.tables import write_table
from fusion.evaluate import FuseSettings, Inputs, evaluate, joined_walks, report_lines, resolved
from fusion.mobilearloc import MobileARLocOptions
from fusion.record import blueprint, record
from fusion.sweep import around, grid, sweep
from fusion.sweep_figure import write_sweep_figure


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
        return Inputs(scene, frames, _read(self.ground_truth), _read(self.predictions))


def evaluate_files(files: Files, out: Path, scene: str, overrides: list[str]) -> None:
    """Evaluate the three tables and write the fuse stage's tables and recording to `out`.

    Frames without a column `split` are all evaluated. UserError for whatever the tables have that can't be evaluated.
    """
    settings = _settings(scene, overrides)
    results = evaluate([files.read(scene)], settings)
    _make(out)
    for name, table in results.tables.items():
        write_table(out / f"{name}.parquet", table, schema("fuse", name))
    with open_recording(out / RECORDING, "fuse", scene, blueprint(results.fused)) as stream:
        record(stream, results.fused, results.gates)
    for line in report_lines(results):
        console.print(line, markup=False)


def sweep_files(files: Files, out: Path, scene: str, overrides: list[str], every: bool, processes: int) -> None:
    """Run the paper's rule over the three tables with other thresholds, one at a time or (`every`) in all combinations
    too; write sweep.parquet and sweep.svg to `out`."""
    settings = _settings(scene, overrides)
    options = resolved(settings.model_copy(update={"methods": ["mobilearloc"]}))["mobilearloc"]
    assert isinstance(options, MobileARLocOptions)
    walks = {(scene, model): joined.walks for model, joined in joined_walks(files.read(scene), settings.splits)}
    chosen = around(options) + (grid(options) if every else [])
    table = sweep(walks, chosen, min(processes, len(walks)))
    _make(out)
    write_table(out / "sweep.parquet", table, schema("fuse", "sweep"))
    write_sweep_figure(table, options.model_dump(), out / "sweep.svg")
    console.print(f"{len(chosen)} settings: {out / 'sweep.parquet'}, {out / 'sweep.svg'}", markup=False)


def _settings(scene: str, overrides: list[str]) -> FuseSettings:
    return resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", scene, overrides)


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError("the output folder can't be made", where=out, found=error) from None


def _read(path: Path) -> pd.DataFrame:
    if not path.is_file():
        raise UserError("there is no such table", where=path, expected="a Parquet file")
    try:
        return pd.read_parquet(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise UserError("a table can't be read", where=path, found=error, expected="a Parquet file") from None
