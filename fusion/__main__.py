"""Command line of the fuse stage, and `evaluate` for tables from anywhere."""

from pathlib import Path
from typing import Annotated

import typer

from artefacts.cli import SetOption, stage_app
from fusion.stage import STAGE
from fusion.tables import evaluate_files

app = stage_app(STAGE)
TableOption = Annotated[Path, typer.Option(help="Parquet; docs/fusion.md has the columns.")]


@app.command()
def evaluate(
    frames: TableOption,
    ground_truth: TableOption,
    predictions: TableOption,
    out: Annotated[Path, typer.Option(help="Folder for the tables and the recording.")],
    scene: Annotated[str, typer.Option(help="The scene's name in the tables.")] = "scene",
    set_: SetOption = None,
) -> None:
    """Fuse and measure predictions of any regressor: three Parquet tables in, the fuse stage's tables out."""
    evaluate_files(frames, ground_truth, predictions, out, scene, set_ or [])


if __name__ == "__main__":
    app()
