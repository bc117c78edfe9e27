"""Command line of the fuse stage, and `evaluate` and `sweep` for tables from anywhere."""

from pathlib import Path
from typing import Annotated

import typer

from groundwalk.fusion.definition import STAGE
from groundwalk.fusion.files.parquet import Files
from groundwalk.fusion.files.tables import evaluate_files, sweep_files
from groundwalk.store.cli import SetOption, stage_app

app = stage_app(STAGE)
TableOption = Annotated[Path, typer.Option(help="Parquet; docs/explanation/fusion.md has the columns.")]


OutOption = Annotated[Path, typer.Option(help="Folder for what is written.")]
NameOption = Annotated[str, typer.Option(help="The scene's name in the tables.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace earlier results in that folder.")]


@app.command()
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
    evaluate_files(Files(frames, ground_truth, predictions), out, scene, set_ or [], force)


@app.command()
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
    sweep_files(Files(frames, ground_truth, predictions), out, scene, set_ or [], force)


if __name__ == "__main__":
    app()
