"""What the blurring of faces finds, and what it blurs for nothing: `python -m benchmarks.import_blurring`.

`--labelled` names a folder of photos whose faces dlib's `imglab` has boxed (`examples/faces` of
https://github.com/davisking/dlib: nine photos of people, 43 faces), `--captures` real captures that show nobody: all
that is found there is false. Writes docs/results/blurring.md.
"""

import time
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.capture_import.capture import ImageFile, Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.blurring import FaceDetector, Region
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track

_HEAD = """Written by `python -m benchmarks.import_blurring`, not to be edited. Photos of people: dlib's
`examples/faces`, where some faces have no box, so that a region outside the boxes may be right. Captures show
nobody: all regions there are false."""
app = new_app(__doc__ or "")


def is_detected(regions: list[Region], centre: tuple[float, float]) -> bool:
    x, y = centre
    return any(r.x < x < r.x + r.width and r.y < y < r.y + r.height for r in regions)


def labelled_faces(folder: Path) -> dict[Path, list[tuple[float, float]]]:
    """The centres of the faces in each photo that `training.xml` and `testing.xml` of the folder name."""
    found: dict[Path, list[tuple[float, float]]] = {}
    for image in (i for name in ("training.xml", "testing.xml") for i in ET.parse(folder / name).iter("image")):
        faces = found.setdefault(folder / image.attrib["file"], [])
        for box in image.iter("box"):
            x, y, width, height = (int(box.attrib[name]) for name in ("left", "top", "width", "height"))
            faces.append((x + width / 2, y + height / 2))
    return found


def _rows(detect: FaceDetector, labelled: Path | None, captures: Path | None, images: int) -> Iterable[list[str]]:
    yield ["images", "number", "faces", "of these found", "other regions an image", "processor s an image"]
    found: dict[str, dict[Path, list[tuple[float, float]]]] = {}
    if labelled is not None:
        found["photos of people"] = labelled_faces(labelled)
    for recording in find_recordings(captures, Path("/nonexistent"), Limits()) if captures else []:
        paths = [f.image.path for f in recording.read(Limits()).frames if isinstance(f.image, ImageFile)]
        paths = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, images).astype(int))]
        found[f"capture {recording.recording_id}"] = {path: [] for path in paths}
    for name, faces_of in found.items():
        start = time.process_time()
        regions = {path: detect(decode_rgb(path.read_bytes(), 2**31)) for path in track(list(faces_of), name)}
        seconds = (time.process_time() - start) / len(faces_of)
        faces = [is_detected(regions[path], face) for path, at in faces_of.items() for face in at]
        false = [r for path, at in faces_of.items() for r in regions[path] if not any(is_detected([r], f) for f in at)]
        share = f"{sum(faces)} ({sum(faces) / len(faces):.0%})" if faces else ""
        counts = [str(len(faces_of)), str(len(faces)), share]
        yield [name, *counts, f"{len(false) / len(faces_of):.2f}", f"{seconds:.2f}"]


@app.command()
def main(
    captures: Annotated[Path | None, typer.Option(help="Real captures that show nobody.")] = None,
    labelled: Annotated[Path | None, typer.Option(help="Photos with boxes of their faces, as dlib's.")] = None,
    face_model: Annotated[Path | None, typer.Option(help="YuNet's file, as [import] face_model names it.")] = None,
    images: Annotated[int, typer.Option(help="Images looked at in each recording, spread over it.")] = 24,
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("docs/results"),
) -> None:
    """Write the tables, by OpenCV's own detectors and by YuNet where its file is named."""
    sections = ["# Blurring of faces", _HEAD]
    for name, model in {"OpenCV's own detectors": None, "YuNet": face_model}.items():
        if name == "YuNet" and model is None:
            continue
        detect = FaceDetector(model)
        sections += [f"## {name}", markdown_table(_rows(detect, labelled, captures, images))]
    write_page(out, "blurring", [*sections, circumstances()])


if __name__ == "__main__":
    app()
