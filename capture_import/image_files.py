"""Image files of a recording, by their names, whatever the case of their suffix."""

from collections.abc import Container, Iterable
from pathlib import Path

from groundwalk.artefacts.choices import Rejected
from groundwalk.capture_import.capture import Reject

# HEIC isn't read: such an image is a reject by its content.
SUFFIXES = (".jpg", ".jpeg", ".png", ".heic", ".heif")


def is_image(path: Path) -> bool:
    """Whether a file's name is that of an image."""
    return path.suffix.lower() in SUFFIXES


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name; none where it isn't there."""
    return sorted(path for path in folder.iterdir() if is_image(path)) if folder.is_dir() else []


def by_stem(images: Iterable[Path]) -> dict[str, Path]:
    """Image files by their name without suffix; of two the one whose suffix is lower-case and first in `SUFFIXES`."""

    def rank(path: Path) -> tuple[bool, int]:
        return path.suffix.islower(), -SUFFIXES.index(path.suffix.lower())

    return {path.stem: path for path in sorted(images, key=rank)}


def unused(
    session_id: str, images: Iterable[Path], used: Container[Path | None], reason: str, root: Path | None = None
) -> list[Reject]:
    """Those image files of a recording that it doesn't use, as rejects, by their paths in the folder `root`, or else
    their names."""
    return [
        Reject(session_id, path.relative_to(root or path.parent).as_posix(), None, reason, Rejected.IMAGE)
        for path in images
        if path not in used
    ]
