"""`python -m groundwalk.capture_import`: the import stage, and a look at captures without importing."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.formats import FORMATS
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.store.cli import stage_app
from groundwalk.store.text import printable

app = stage_app(STAGE)


@app.command("formats")
def formats_command() -> None:
    """List the capture formats that import reads."""
    table = Table("name", "format", "gives", "recognised by", box=None, pad_edge=False)
    for format in FORMATS.values():
        table.add_row(format.id, format.label, format.meaning, format.recognised_by)
    Console(highlight=False).print(table)


@app.command("inspect")
def inspect_command(
    path: Annotated[Path, typer.Argument(help="A capture: a folder of recordings, or one recording.")],
    format: Annotated[str, typer.Option(help="The capture's format, as `formats` lists it.")] = "auto",
) -> None:
    """Print what a capture holds, its health and whether it can be used, without importing it.

    Ends with 1 where a recording can't be used (its status is unusable or wrong convention), with 2 where the
    capture can't be read, else with 0.
    """
    unusable: list[str] = []
    for line in inspect_capture(path, format, unusable):
        typer.echo(printable(line))
    if unusable:
        raise typer.Exit(1)


if __name__ == "__main__":
    app()
