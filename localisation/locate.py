"""`groundwalk locate`: new images in a map's file or by a regressor's bundle, without a run."""

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from groundwalk.runtime.bundle import Prediction, open_bundle
from groundwalk.runtime.queries import Query, file_query, image_files, numbers
from groundwalk.store import UserError, progress
from groundwalk.store.choices import Refusal
from groundwalk.store.cli import new_app
from groundwalk.store.files import make_writable, written_aside

if TYPE_CHECKING:
    from groundwalk.localisation.localisers import FileLocaliser
    from groundwalk.localisation.results import QueryResult

app = new_app("New images in a map's file, or by a regressor's bundle.")
Row = dict[str, Any]


@app.command()
def locate(
    images: Annotated[Path, typer.Argument(help="An image, or a folder of images.")],
    map_: Annotated[
        Path | None, typer.Option("--map", help="The map's file, map.gwm of a scene's stage localise.")
    ] = None,
    bundle: Annotated[
        Path | None, typer.Option(help="A regressor's bundle, as `groundwalk export --format phone` writes it.")
    ] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Ask the bundle's golden queries first.")] = False,
    network: Annotated[str, typer.Option(help="The bundle's network, fp32 or int8; the recommended one.")] = "",
    intrinsics: Annotated[
        str, typer.Option(help="fx,fy,cx,cy in pixels of the images; instead of a JSON file beside them.")
    ] = "",
    gravity: Annotated[str, typer.Option(help="x,y,z: down, in the camera (x right, y down, z forward).")] = "",
    scene: Annotated[str, typer.Option(help="The scene that the map or bundle has to be of.")] = "",
    out: Annotated[
        Path | None,
        typer.Option(help="A file for the answers, one JSON object a line; earlier answers there are replaced."),
    ] = None,
) -> None:
    """Say where images were taken: a pose in the map with its covariance, or a refusal with its reason.

    An image's intrinsics are in `<image>.json` or `intrinsics.json` beside it, or in --intrinsics: an object with fx,
    fy, cx, cy and, where they are known, width, height, first_row (the side of the image that the sensor reads out
    first: top, right, bottom or left), gravity and prior (map_T_cam, 4x4), or 3D Scanner App's file of the frame.
    --intrinsics are taken before those of intrinsics.json, and those of an image's own file before both. An image of a
    folder that can't be asked is refused as bad_input; it's an error where that is so of all.
    """
    ask = _opened(map_, bundle, scene, network, verify)
    common: Row = {}
    if intrinsics:
        common |= dict(zip(("fx", "fy", "cx", "cy"), numbers(intrinsics, 4, "--intrinsics"), strict=True))
    if gravity:
        common["gravity"] = numbers(gravity, 3, "--gravity")
    rows = []
    paths = image_files(images)
    if out is not None:
        _refuse_other_file(out)
        make_writable(out.parent)
    for path in progress.track(paths, "localising", len(paths)):
        row = {"image": path.name, **_answer(ask, path, common, among_others=images.is_dir())}
        rows.append(row)
        if out is None:
            typer.echo(json.dumps(row))
    if out is not None:
        with written_aside(out) as partial:
            partial.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    refused = sum(row["refusal"] is not None for row in rows)
    progress.console.print(f"{len(rows) - refused} of {len(rows)} images localised, {refused} refused")
    if all(row["refusal"] == Refusal.BAD_INPUT for row in rows):
        raise UserError("no image of the folder can be asked", where=images, found=rows[0]["reason"])


def _refuse_other_file(out: Path) -> None:
    """UserError where anything but earlier answers is there."""
    if not os.path.lexists(out):
        return
    kind = "a folder" if out.is_dir() else "a link" if out.is_symlink() else "" if out.is_file() else "no file"
    if not kind:
        with suppress(OSError, ValueError, RecursionError):
            rows = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
            if all(isinstance(row, dict) and {"image", "refusal"} <= row.keys() for row in rows):
                return
    do = "name another file with --out, or leave it out to have the answers printed"
    raise UserError("this is no file of earlier answers, which alone is replaced", where=out, found=kind or None, do=do)


def _answer(ask: Callable[[Query], Row], path: Path, common: Row, *, among_others: bool) -> Row:
    """What is said of an image; one among others that can't be asked is refused, alone it's a UserError."""
    try:
        query = file_query(path, common)
    except UserError as error:
        if not among_others:
            raise
        actual = error.details["found"]
        reason = error.what if actual is None else f"{error.what}: {actual}"
        nothing: Row = dict.fromkeys(("position_m", "quaternion", "covariance"))
        return nothing | {"refusal": Refusal.BAD_INPUT, "reason": reason}
    return ask(query)


def read_localiser(path: Path, scene: str = "") -> "FileLocaliser":
    """The localiser of a map's file; UserError where it can't be used, or is of another scene than `scene`."""
    from groundwalk.localisation.localisers import LOCALISERS

    suffixes = {entry.file.suffix: entry.file for entry in LOCALISERS.values() if entry.file is not None}
    if not path.is_file():
        raise UserError("there is no such map", where=path, do="name map.gwm of a scene's stage localise")
    if path.suffix not in suffixes:
        raise UserError("this isn't a map's file", where=path, expected=f"a name that ends in {', '.join(suffixes)}")
    localiser: FileLocaliser = suffixes[path.suffix].read(path)
    if scene and localiser.scene != scene:
        raise UserError("a map is of another scene", where=path, expected=scene, found=localiser.scene)
    return localiser


def _opened(map_: Path | None, bundle: Path | None, scene: str, network: str, verify: bool) -> Callable[[Query], Row]:
    """What answers a query with a row: the map or the bundle, whichever is named."""
    if (map_ is None) == (bundle is None):
        options = "neither" if map_ is None else "both"
        raise UserError("images are localised in a map or by a bundle", expected="--map or --bundle", found=options)
    if bundle is not None:
        opened = open_bundle(bundle, network=network or None)
        scenes = opened.manifest["scenes"]
        if scene and scene not in scenes:
            raise UserError("a bundle is of another scene", where=bundle, expected=scene, found=", ".join(scenes))
        if verify:
            progress.console.print(f"{opened.verify()} golden queries come out as they should")
        return lambda query: _row(opened.ask(query))
    if map_ is None or network or verify:
        raise UserError("--network and --verify are about a bundle", expected="--bundle", found="--map")
    localiser = read_localiser(map_, scene)
    from groundwalk.localisation.results import row_of  # not for a bundle, which needs less than maps do

    return lambda query: row_of(ask_map(localiser, query))


def ask_map(localiser: "FileLocaliser", query: Query) -> "QueryResult":
    """The localiser's answer."""
    import cv2

    from groundwalk.store.parallel import one_thread

    grey = query.image if query.image.ndim == 2 else np.asarray(cv2.cvtColor(query.image, cv2.COLOR_RGB2GRAY), np.uint8)
    with one_thread():
        return localiser.localise(grey, query.camera, query.gravity, query.prior)


def _row(prediction: Prediction) -> Row:
    """A prediction as plain values, with the names that a map's answers have."""
    covariance = prediction.covariance
    return {
        "position_m": prediction.position.tolist(),
        "quaternion": prediction.quaternion.tolist(),
        "covariance": None if covariance is None else covariance.ravel().tolist(),
        "scene": prediction.scene,
        "milliseconds": {part: round(1e3 * seconds, 2) for part, seconds in prediction.seconds.items()},
        "refusal": None,
        "reason": None,
    }
