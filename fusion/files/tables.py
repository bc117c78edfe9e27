"""`python -m groundwalk.fusion evaluate` and `sweep`: on three Parquet tables from anywhere."""

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from groundwalk.fusion.evaluation.evaluate import (
    FuseSettings,
    evaluate,
    joined_walks,
    report_lines,
    rule_options,
)
from groundwalk.fusion.evaluation.sweep import around, sweep, write_sweep_figure
from groundwalk.fusion.files.parquet import Files
from groundwalk.fusion.recording import blueprint, record
from groundwalk.fusion.walk import with_odometry
from groundwalk.store import DataRoot, UserError
from groundwalk.store.files import RECORDING, file_names, fresh_folder, refuse_to_overwrite, write_json
from groundwalk.store.progress import console
from groundwalk.store.recording import open_recording
from groundwalk.store.schemas import schema
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings
from groundwalk.store.tables import write_table

_NOTE = "evaluation.json"


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
            record(stream, results.fused, results.gates, {})
        _write_note(folder, files, scene, settings, dict(results.counts))
    for line in report_lines(results):
        console.print(line)


def sweep_files(files: Files, out: Path, scene: str, overrides: list[str], force: bool = False) -> None:
    """Run the paper's rule over the three tables with other thresholds, one at a time; write sweep.parquet and
    sweep.svg to the folder `out`, as `evaluate_files` does."""
    settings = _settings(scene, overrides)
    options = rule_options(settings)
    chosen = around(options)
    with _written(out, force) as folder:
        joined = joined_walks(files.read(scene), settings.splits)
        walks = {(scene, model): on for model, of_model in joined if (on := with_odometry(of_model.walks))}
        if not walks:
            raise UserError("nothing can be fused: no frame has a pose by odometry", where=files.frames)
        table = sweep(walks, chosen)
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
