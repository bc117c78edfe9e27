"""Image files by their names, whatever the case of their suffix."""

from collections.abc import Iterable
from pathlib import Path

from groundwalk.store.text import natural_order

# HEIC is read where its decoder is installed; else such an image is a reject, which says what to do.
SUFFIXES = (".jpg", ".jpeg", ".png", ".heic", ".heif")


def is_image(path: Path) -> bool:
    """Whether a file's name is that of an image."""
    return path.suffix.lower() in SUFFIXES


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder, in natural order of their names; none where it isn't there."""
    return in_order(path for path in folder.iterdir() if is_image(path)) if folder.is_dir() else []


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Paths in natural order: frame2 before frame10."""
    return sorted(paths, key=lambda path: natural_order(path.as_posix()))


def by_stem(images: Iterable[Path]) -> dict[str, Path]:
    """Image files by their name without suffix; of two the one whose suffix is lower-case and first in `SUFFIXES`."""

    def rank(path: Path) -> tuple[bool, int]:
        return path.suffix.islower(), -SUFFIXES.index(path.suffix.lower())

    return {path.stem: path for path in sorted(images, key=rank)}
