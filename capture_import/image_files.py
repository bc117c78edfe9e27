"""Image files of a recording, by their names, whatever the case of their suffix."""

from collections.abc import Container, Iterable
from pathlib import Path

from groundwalk.capture_import.capture import RawFrame, Reject
from groundwalk.capture_import.media.images import BadImage, image_size
from groundwalk.capture_import.parsing import BadRow
from groundwalk.store.choices import Rejected
from groundwalk.store.text import natural_order

# HEIC isn't read: such an image is a reject by its content.
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


def size_of(image: Path) -> tuple[int, int]:
    """(width, height) of an image file by its header; BadRow where it can't be read."""
    if not image.is_file():
        raise BadRow("image is missing, or no ordinary file")
    try:
        with image.open("rb") as file:
            return image_size(file.read(1 << 16))
    except (OSError, BadImage) as error:
        raise BadRow(f"image can't be read: {error}") from None


def size_notes(frames: Iterable[RawFrame]) -> list[str]:
    """A note on images whose size their log doesn't state, so that nothing shows images that were scaled."""
    count = sum(frame.intrinsics is not None and frame.intrinsics.width is None for frame in frames)
    return [f"the log states no size of {count} images: their intrinsics are taken for the files' own"] if count else []
