"""The commands `evaluate` and `sweep`: on three Parquet tables from anywhere."""

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation import evaluate as evaluation
from groundwalk.fusion.evaluation import sweep as sweeping
from groundwalk.fusion.files.walks import Files
from groundwalk.fusion.recording import blueprint, record
from groundwalk.fusion.walk import with_odometry
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import SetOption
from groundwalk.store.files import RECORDING, file_names, fresh_folder, refuse_to_overwrite, write_json
from groundwalk.store.progress import console
from groundwalk.store.recording import open_recording
from groundwalk.store.schemas import schema
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings
from groundwalk.store.tables import write_table

TableOption = Annotated[Path, typer.Option(help="Parquet; docs/explanation/fusion.md has the columns.")]
OutOption = Annotated[Path, typer.Option(help="Folder for what is written.")]
NameOption = Annotated[str, typer.Option(help="The scene's name in the tables.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace earlier results in that folder.")]
_NOTE = "evaluation.json"


def evaluate(
    frames: TableOption,
    ground_truth: TableOption,
    predictions: TableOption,
    out: OutOption,
    scene: NameOption = "scene",
    set_: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Fuse and measure predictions of any regressor: three Parquet tables in, the fuse stage's tables out."""
    files, settings = Files(frames, ground_truth, predictions), _settings(scene, set_)
    with _written(out, force) as folder:
        results = evaluation.evaluate([files.read(scene)], settings)
        for name, table in results.tables.items():
            write_table(folder / f"{name}.parquet", table, schema("fuse", name))
        with open_recording(folder / RECORDING, "fuse", scene, blueprint(results.fused, results.gates)) as stream:
            record(stream, results.fused, results.gates, {})
        _write_note(folder, files, scene, settings, dict(results.counts))
    for line in evaluation.report_lines(results):
        console.print(line)


def sweep(
    frames: TableOption,
    ground_truth: TableOption,
    predictions: TableOption,
    out: OutOption,
    scene: NameOption = "scene",
    set_: SetOption = None,
    force: ForceOption = False,
) -> None:
    """The paper's rule with other thresholds: how errors and coverage move with N, d_th, o_th and gamma."""
    files, settings = Files(frames, ground_truth, predictions), _settings(scene, set_)
    options = evaluation.rule_options(settings)
    chosen = sweeping.around(options)
    with _written(out, force) as folder:
        joined = evaluation.joined_walks(files.read(scene), settings.splits)
        walks = {(scene, model): on for model, of_model in joined if (on := with_odometry(of_model.walks))}
        if not walks:
            raise UserError("nothing can be fused: no frame has a pose by odometry", where=frames)
        table = sweeping.sweep(walks, chosen)
        write_table(folder / "sweep.parquet", table, schema("fuse", "sweep"))
        sweeping.write_sweep_figure(table, options.model_dump(), folder / "sweep.svg")
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


def _settings(scene: str, overrides: list[str] | None) -> FuseSettings:
    return resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", scene, overrides or [])
