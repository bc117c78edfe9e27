"""Command line of the fuse stage, and `evaluate`, `sweep` and `leaderboard` for tables from anywhere."""

from pathlib import Path
from typing import Annotated

import typer

from groundwalk.fusion.definition import STAGE
from groundwalk.fusion.evaluation.leaderboard import run_leaderboard
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


@app.command()
def leaderboard(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of GROUP/SCENE/ with frames.parquet, ground_truth.parquet and predictions.parquet."
        ),
    ] = None,
    data: Annotated[Path, typer.Option(help="The data folder, whose finished runs take part.")] = Path("data"),
    out: Annotated[Path, typer.Option(help="Folder for fusion.md and fusion.csv.")] = Path("build/leaderboard"),
    methods: Annotated[str, typer.Option(help="Methods, joined by commas; all if empty.")] = "",
    processes: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 1,
) -> None:
    """All methods on predictions laid in folders and on finished runs: figures, and which is ahead in each scene."""
    run_leaderboard(folders or [], data, out, [name.strip() for name in methods.split(",") if name.strip()], processes)


if __name__ == "__main__":
    app()
