"""`groundwalk locate`: new images in a map's file, without a run."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from groundwalk.artefacts import UserError, progress
from groundwalk.artefacts.choices import Refusal
from groundwalk.artefacts.cli import new_app
from groundwalk.artefacts.files import written_aside
from groundwalk.localisation.answers import Answer, Clock, refused
from groundwalk.localisation.localisers import LOCALISERS, FileLocaliser
from groundwalk.localisation.one_query import Query, ask, query_of, row_of

_IMAGES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
_INTRINSICS = "intrinsics.json"


app = new_app("New images in a map's file.")


@app.command()
def locate(
    images: Annotated[Path, typer.Argument(help="An image, or a folder of images.")],
    map_: Annotated[Path, typer.Option("--map", help="The map's file, map.gwm of a scene's stage localise.")],
    intrinsics: Annotated[
        str, typer.Option(help="fx,fy,cx,cy in pixels of the images; instead of a JSON file beside them.")
    ] = "",
    gravity: Annotated[str, typer.Option(help="x,y,z: down, in the camera (x right, y down, z forward).")] = "",
    scene: Annotated[str, typer.Option(help="The scene that the map has to be of.")] = "",
    out: Annotated[Path | None, typer.Option(help="A file for the answers, one JSON object a line.")] = None,
) -> None:
    """Say where images were taken: a pose in the map with its covariance, or a refusal with its reason.

    An image's intrinsics are in `<image>.json` or `intrinsics.json` beside it, or in --intrinsics: an object with fx,
    fy, cx, cy and, where they are known, width, height, gravity and prior (map_T_cam, 4x4). An image whose own file has
    other intrinsics is asked with these. An image of a folder that can't be asked is refused as bad_input.
    """
    localiser = read_localiser(map_, scene)
    common: dict[str, Any] = {}
    if intrinsics:
        common |= dict(zip(("fx", "fy", "cx", "cy"), _numbers(intrinsics, 4, "--intrinsics"), strict=True))
    if gravity:
        common["gravity"] = _numbers(gravity, 3, "--gravity")
    rows = []
    paths = _image_files(images)
    for path in progress.track(paths, "localising", len(paths)):
        row = {"image": path.name, **row_of(_answer(localiser, path, common, among_others=images.is_dir()))}
        rows.append(row)
        if out is None:
            typer.echo(json.dumps(row))
    if out is not None:
        with written_aside(out) as partial:
            partial.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    refused = sum(row["refusal"] is not None for row in rows)
    progress.console.print(f"{len(rows) - refused} of {len(rows)} images localised, {refused} refused", markup=False)


def _answer(localiser: FileLocaliser, path: Path, common: dict[str, Any], *, among_others: bool) -> Answer:
    """What is said of an image; one among others that can't be asked is refused, alone it's a UserError."""
    try:
        query = _query(path, common)
    except UserError as error:
        if not among_others:
            raise
        found = error.details["found"]
        return refused(Refusal.BAD_INPUT, error.what if found is None else f"{error.what}: {found}", Clock())
    return ask(localiser, query)


def read_localiser(path: Path, scene: str = "") -> FileLocaliser:
    """The localiser of a map's file; UserError where it can't be used, or is of another scene than `scene`."""
    suffixes = {entry.file.suffix: entry.file for entry in LOCALISERS.values() if entry.file is not None}
    if not path.is_file():
        raise UserError("there is no such map", where=path, do="name map.gwm of a scene's stage localise")
    if path.suffix not in suffixes:
        raise UserError("this isn't a map's file", where=path, expected=f"a name that ends in {', '.join(suffixes)}")
    localiser: FileLocaliser = suffixes[path.suffix].read(path)
    if scene and localiser.scene != scene:
        raise UserError("a map is of another scene", where=path, expected=scene, found=localiser.scene)
    return localiser


def _image_files(images: Path) -> list[Path]:
    if images.is_file():
        return [images]
    found = sorted(path for path in images.glob("*") if path.suffix.lower() in _IMAGES) if images.is_dir() else []
    if not found:
        kind = "no image in this folder" if images.is_dir() else "no such file or folder"
        raise UserError(
            "there are no images to localise", where=images, found=kind, expected=", ".join(sorted(_IMAGES))
        )
    return found


def _query(path: Path, common: dict[str, Any]) -> Query:
    """An image with what is known of it: what the command says, then the folder's file, then its own."""
    known = dict(common)
    for file in (path.with_name(_INTRINSICS), path.with_name(path.name + ".json"), path.with_suffix(".json")):
        if file.is_file():
            known |= _object(file)
    where = f"{path.name}.json or {_INTRINSICS} beside {path}, or --intrinsics fx,fy,cx,cy"
    return query_of(path, known, where)


def _object(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError("a file with intrinsics can't be read", where=file, found=error, expected="JSON") from None
    if not isinstance(content, dict):
        raise UserError("a file with intrinsics has something else", where=file, expected="a JSON object")
    return content


def _numbers(text: str, count: int, option: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise UserError(
            f"{option} has something else than numbers", found=text, expected=f"{count} numbers with commas"
        )
    return numbers
