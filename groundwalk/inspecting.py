"""The command `inspect`: what a capture holds, whether it can be used, and what to do better in the next walk."""

from pathlib import Path
from typing import Annotated

import typer

from groundwalk.capture_advice import advice_on
from groundwalk.capture_import.capture import Session
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.store.cli import new_app
from groundwalk.store.text import printable

app = new_app("What a capture holds.")


@app.command("inspect")
def inspect_command(
    path: Annotated[Path, typer.Argument(help="A capture: a folder of recordings, or one recording.")],
    format: Annotated[str, typer.Option(help="The capture's format, as `formats` lists it.")] = "auto",
) -> None:
    """Print what a capture holds, its health, whether it can be used and what to do better, without importing it.

    Ends with 1 where a recording can't be used (its status is unusable or wrong convention), with 2 where the
    capture can't be read, else with 0.
    """
    unusable: list[str] = []
    better: list[str] = []
    recordings: set[str] = set()

    def look(sessions: list[Session], has_up: bool, reader: ImageReader) -> None:
        for session in (session for session in sessions if session.images):
            recordings.add(session.recording.recording_id)
            better.extend(f"{session.session_id}: {what} ({why})" for what, why in advice_on(session, has_up, reader))

    for line in inspect_capture(path, format, unusable, look):
        typer.echo(printable(line))
    if len(recordings) == 1:
        better.append("record a second walk over the same ground (one walk can't be tested by another)")
    if better:
        typer.echo("in the next walk")
    for line in better:
        typer.echo(printable(f"  {line}"))
    if unusable:
        raise typer.Exit(1)
