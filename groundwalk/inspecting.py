"""The command `inspect`: what a capture holds and whether it can be used, in lines and on a page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groundwalk.capture_import.capture import Session
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.store.cli import new_app
from groundwalk.store.errors import UserError
from groundwalk.store.files import written_aside
from groundwalk.store.text import printable

if TYPE_CHECKING:
    from groundwalk.capture_page import Look

app = new_app("What a capture holds.")


@app.command("inspect")
def inspect_command(
    path: Annotated[Path, typer.Argument(help="A capture: a folder of recordings, or one recording.")],
    format: Annotated[str, typer.Option(help="The capture's format, as `formats` lists it.")] = "auto",
    html: Annotated[
        Path | None, typer.Option(help="Write a page, too: pictures, path, blur, what to do better.")
    ] = None,
) -> None:
    """Print what a capture holds, its health and whether it can be used, without importing it.

    Ends with 1 where a recording can't be used (its status is unusable or wrong convention), with 2 where the
    capture can't be read, else with 0.
    """
    if html is not None and (html.is_dir() or not html.absolute().parent.is_dir()):
        raise UserError("the page can't be written there", where=html, expected="a file in a folder that exists")
    unusable: list[str] = []
    lines: list[str] = []
    looks: list[Look] = []

    def look(sessions: list[Session], has_up: bool, reader: ImageReader) -> None:
        from groundwalk.capture_page import look_at  # drawing takes a second to load

        looks.extend(look_at(session, has_up, reader) for session in sessions if session.images)

    for line in inspect_capture(path, format, unusable, look if html else None):
        lines.append(printable(line))
        typer.echo(lines[-1])
    if html is not None:
        from groundwalk.capture_page import capture_page

        page = capture_page(path.resolve().name, looks, lines)
        with written_aside(html) as file:
            file.write_text(page, encoding="utf-8")
        typer.echo(f"look at {html}")
    if unusable:
        raise typer.Exit(1)
