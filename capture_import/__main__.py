"""`python -m groundwalk.capture_import`: the import stage, and the formats that it reads."""

from rich.console import Console
from rich.table import Table

from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.formats import FORMATS
from groundwalk.store.cli import stage_app

app = stage_app(STAGE)


@app.command("formats")
def formats_command() -> None:
    """List the capture formats that import reads."""
    table = Table("name", "format", "gives", "recognised by", box=None, pad_edge=False)
    for format in FORMATS.values():
        table.add_row(format.id, format.label, format.meaning, format.recognised_by)
    Console(highlight=False).print(table)


if __name__ == "__main__":
    app()
