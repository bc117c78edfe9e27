"""Data sets with one file of poses over a folder `images/`: each of its folders of images is a recording."""

from collections.abc import Callable
from pathlib import Path

from groundwalk.artefacts.choices import SessionSplit
from groundwalk.artefacts.simulated import EXPORT_NOTE
from groundwalk.capture_import.capture import Reject
from groundwalk.capture_import.image_files import images_in, is_image, unused
from groundwalk.capture_import.parsing import BadRow, parse_json, read_text

# How far below images/ a recording's folder may lie.
_MAX_DEPTH = 3


def data_set_of(path: Path, is_data_set: Callable[[Path], bool]) -> Path | None:
    """The data set's folder whose recording `path` is; None where it's none.

    Where images lie in folders of `images/`, each of these is a recording; else the data set as a whole is one.
    """
    if not path.is_dir():
        return None
    if is_data_set(path):
        return None if _nested(path / "images") else path
    if not _has_images(path):
        return None
    for parent in path.parents[1 : 2 + _MAX_DEPTH]:
        if path.is_relative_to(parent / "images") and is_data_set(parent):
            return parent if _nested(parent / "images") else None
    return None


def rows_of(data_set: Path, recording: Path, names: list[tuple[str, Path]]) -> list[tuple[str, Path]]:
    """The (source, image) rows of a data set that lie in a recording's folder, in the order of their images' names."""
    rows = [row for row in names if recording == data_set or row[1].parent == recording]
    return sorted(rows, key=lambda row: row[1].as_posix())


def lost_rows(names: list[tuple[str, Path]]) -> list[str]:
    """A note about rows of a data set whose image folders are missing."""
    lost = [source for source, image in names if not image.parent.is_dir()]
    return [f"{len(lost)} rows name images in missing folders, such as {lost[0]}"] if lost else []


def unnamed_images(session_id: str, images: list[Path]) -> list[Reject]:
    """The image files beside the `images` that a recording's rows name which none of them names, as rejects."""
    named = set(images)
    folders = sorted({image.parent for image in images if image.parent.is_dir()})
    beside = [image for folder in folders for image in images_in(folder)]
    return unused(session_id, beside, named, "image isn't among those with poses")


def split_of(images: list[Path], test: set[Path]) -> SessionSplit | None:
    """What a recording with these images is for, where the data set names its `test` images; None where it's mixed."""
    tested = sum(image in test for image in images)
    if not test or 0 < tested < len(images):
        return None
    return SessionSplit.TEST if tested else SessionSplit.TRAIN


def is_metric_export(data_set: Path) -> bool:
    """Whether it's an export of groundwalk, whose world is metric with +y up; other files of these kinds state no
    unit."""
    try:
        note = parse_json(read_text(data_set / EXPORT_NOTE, 1 << 20))
    except BadRow:
        return False
    return str(note.get("map", "")).startswith("metres, +y up")


def _nested(images: Path) -> bool:
    return images.is_dir() and not _has_images(images) and any(p.is_dir() for p in images.iterdir())


def _has_images(folder: Path) -> bool:
    return any(is_image(p) for p in folder.iterdir())
