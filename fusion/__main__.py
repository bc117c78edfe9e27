"""Command line of the fuse stage, and `evaluate`: on three Parquet tables from anywhere."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from groundwalk.fusion.definition import STAGE, FuseSettings
from groundwalk.fusion.evaluation import evaluate as evaluation
from groundwalk.fusion.evaluation.sweep import write_sweep_figure
from groundwalk.fusion.files.walks import Files
from groundwalk.fusion.recording import blueprint, record
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import SetOption, stage_app
from groundwalk.store.files import RECORDING, file_names, fresh_folder, refuse_to_overwrite, sha256_of, write_json
from groundwalk.store.progress import console
from groundwalk.store.recording import open_recording
from groundwalk.store.schemas import schema
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings
from groundwalk.store.tables import write_table

app = stage_app(STAGE)
TableOption = Annotated[Path, typer.Option(help="Parquet; docs/explanation/fusion.md has the columns.")]
_NOTE = "evaluation.json"


@app.command()
def evaluate(
    frames: TableOption,
    ground_truth: TableOption,
    predictions: TableOption,
    out: Annotated[Path, typer.Option(help="Folder for what is written.")],
    scene: Annotated[str, typer.Option(help="The scene's name in the tables.")] = "scene",
    set_: SetOption = None,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results in that folder.")] = False,
) -> None:
    """Fuse and measure predictions of any regressor: three Parquet tables in, the fuse stage's tables out."""
    files = Files(frames, ground_truth, predictions)
    settings = resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", scene, set_ or [])
    with _written(out, force) as folder:
        results = evaluation.evaluate([files.read(scene)], settings)
        for name, table in results.tables.items():
            write_table(folder / f"{name}.parquet", table, schema("fuse", name))
        if "sweep" in results.tables:
            write_sweep_figure(results.tables["sweep"], folder / "sweep.svg")
        with open_recording(folder / RECORDING, "fuse", scene, blueprint(results.fused, results.gates)) as stream:
            record(stream, results.fused, results.gates, {})
        inputs = {name: {"file": str(path), "sha256": sha256_of(path)} for name, path in vars(files).items()}
        note = {"scene": scene, "inputs": inputs, "settings": settings.model_dump(mode="json")}
        # Last, as it says which files the results are.
        write_json(folder / _NOTE, {**note, "counts": dict(results.counts), "files": file_names(folder)})
    for line in evaluation.report_lines(results):
        console.print(line)


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


if __name__ == "__main__":
    app()
