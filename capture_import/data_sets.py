"""Data sets with one file of poses over folders of images, each of which is a recording."""

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Intrinsics, RawFrame, Recording, Reject
from groundwalk.capture_import.media.images import BadImage, image_size
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import Clock, PoseSource, SessionSplit
from groundwalk.store.files import leads_outside, read_json
from groundwalk.store.simulated import EXPORT_NOTE
from groundwalk.store.text import natural_order, printable

Row = TypeVar("Row")

NO_DISTORTION = (0.0,) * 4
"""Stated to be none: of images that were undistorted, or drawn."""
# How far below a data set's folder of images a recording's may lie.
_MAX_DEPTH = 3


def size_of(image: Path) -> tuple[int, int]:
    """(width, height) of an image file by its header; BadRow where it can't be read."""
    if not image.is_file():
        raise parsing.BadRow("image is missing, or no ordinary file")
    try:
        with image.open("rb") as file:
            start = file.read(1 << 16)
            try:
                return image_size(start)
            except BadImage:  # of a HEIC all is needed, and metadata of others may be larger
                return image_size(start + file.read(1 << 26))
    except BadImage as error:
        raise parsing.BadRow(f"image {error}") from None
    except OSError as error:
        raise parsing.BadRow(f"image can't be read: {error}") from None


def guessed_intrinsics(width: int, height: int, focal_sd: float = 0.0) -> Intrinsics:
    """Intrinsics of an image of this size that nothing states: of the focal length that COLMAP assumes, too."""
    f = 1.2 * max(width, height)
    return Intrinsics(f, f, width / 2, height / 2, width, height, focal_sd=focal_sd)


def reference(
    device: str, clock: Clock, folder: Path, frames: Sequence[RawFrame], rejects: Sequence[Reject], **stated: Any
) -> Recording:
    """A recording with poses from elsewhere, in a world of which nothing says where up is unless that's `stated`."""
    stated = {"is_gravity_aligned": False} | stated
    return Recording(device, clock, folder, frames, rejects, PoseSource.REFERENCE, **stated)


def images_alone(
    clock: Clock, folder: Path, frames: Sequence[RawFrame], rejects: Sequence[Reject], notes: Sequence[str]
) -> Recording:
    """A recording of images without poses, and so without scale, vertical or intrinsics that anything states."""
    return Recording(
        "unknown",
        clock,
        folder,
        frames,
        rejects,
        pose_source=PoseSource.NONE,
        is_gravity_aligned=False,
        is_metric=False,
        has_intrinsics=False,
        notes=notes,
    )


def data_set_of(path: Path, images_of: Callable[[Path], Path | None]) -> Path | None:
    """The data set's folder whose recording `path` is; None where it's none.

    `images_of` gives the folder of a data set's images, None for a folder that is no data set. Where images lie in
    folders below it, each of these is a recording; else the data set as a whole is one.
    """
    if not path.is_dir():
        return None
    if (images := images_of(path)) is not None:
        return None if _nested(path, images) else path
    if not _has_images(path):
        return None
    for parent in path.parents[1 : 2 + _MAX_DEPTH]:
        images = images_of(parent)
        if images is not None and path.is_relative_to(images):
            return parent if _nested(parent, images) else None
    return None


def folder_with(data_set: Path, names: Sequence[str]) -> Path:
    """The folder that has most of the images of these names: `images/` where none has more, another one in the data
    set, or itself. Of copies of other sizes (images_2) the first counts, of folders with other images beside these the
    one with the fewest."""
    beside = parsing.in_order(
        p for p in data_set.iterdir() if p.is_dir() and p.name != "images" and not p.name.startswith(".")
    )

    def rank(folder: Path) -> tuple[int, bool, int]:
        return count_in(folder, names), folder.name == "images", -len(parsing.images_in(folder))

    return max((data_set / "images", *beside, data_set), key=rank)


def count_in(folder: Path, names: Iterable[str]) -> int:
    """How many images of these names are in a folder."""
    count = 0
    for name in names if folder.is_dir() else ():
        with contextlib.suppress(parsing.BadRow):  # `read` refuses names that lead elsewhere
            count += parsing.inside(folder, name).is_file()
    return count


def lost_images(names: Sequence[str]) -> str:
    """What a data set lacks whose images, of these names, aren't there."""
    return f"a folder with the {len(names)} images that it names, such as {names[0][:60]}," if names else "images/"


def named_image(folders: Sequence[Path], name: Any) -> Path:
    """The image that a data set names relative to the first of these folders, with or without its suffix; of a path on
    another machine, as Windows parts names, too, the end that is in one of them. BadRow for a name that is no text or
    leads elsewhere."""
    parts = name.replace("\\", "/").split("/") if isinstance(name, str) else []
    ends = [end for n in range(len(parts)) if (end := "/".join(parts[n:])) and not leads_outside(end)]
    images = (_with_suffix(folder / end) for end in ends for folder in folders)
    return next((image for image in images if image.is_file()), None) or _with_suffix(parsing.inside(folders[0], name))


def _with_suffix(image: Path) -> Path:
    if parsing.is_image(image):
        return image
    names = [image.name + end for suffix in parsing.SUFFIXES for end in (suffix, suffix.upper())]
    there = [image.with_name(name) for name in names if image.with_name(name).is_file()]
    return there[0] if there else image.with_name(image.name + ".png")


def named_for_testing(folders: Sequence[Path], names: Iterable[Any]) -> set[Path]:
    """The images that a list names for testing, as `named_image` finds them; other names stay as they are."""
    images = set()
    for name in names:
        try:
            images.add(named_image(folders, name))
        except parsing.BadRow:
            images.add(Path(str(name)))
    return images


def read_reference(
    path: Path,
    data_set: Path,
    rows: Sequence[tuple[str, Path, Row]],
    read: Callable[[Path, Row], tuple[Array, Intrinsics]],
    tested: set[Path],
    notes: Sequence[str],
) -> Recording:
    """The recording `path` of a data set's rows (source, image, what is stated): of images in the order of their names,
    with the pose and camera that `read` gives, which may raise BadRow. `tested`: the images that the data set names for
    testing, empty where it has no split; where none is one of its rows', a note says so, and there is none.

    The unit and up of its world are known of groundwalk's own exports alone, whose cameras state all distortion."""
    own = [(source, (image, row)) for source, image, row in rows if path in (data_set, image.parent)]
    own.sort(key=lambda of_one: natural_order(of_one[1][0].as_posix()))
    if lost := [source for source, image, _ in rows if not image.parent.is_dir()]:
        notes = [f"{len(lost)} rows name images in missing folders, such as {lost[0]}", *notes]
    if tested and tested.isdisjoint(image for _, image, _ in rows):
        example = printable(min(tested).name)
        notes = [f"no split: of the {len(tested)} images named for testing, such as {example}, none is here", *notes]
        tested = set()
    ours, is_metric = bool(export_world(data_set)), is_metric_export(data_set)

    def read_row(place: int, row: tuple[Path, Row]) -> RawFrame:
        pose, camera = read(*row)
        if ours and not camera.distortion:
            camera = replace(camera, distortion=NO_DISTORTION)
        split = (SessionSplit.TEST if row[0] in tested else SessionSplit.TRAIN) if tested else None
        return RawFrame(parsing.seconds_to_ns(place), pose, ImageFile(row[0]), camera, split=split)

    frames, rejects = parsing.read_rows(own, read_row)
    stated = {"is_gravity_aligned": is_metric, "is_metric": is_metric, "notes": notes}
    return reference("unknown", Clock.NAME_ORDER, path, frames, rejects, **stated)


def is_metric_export(data_set: Path) -> bool:
    """Whether it's an export of groundwalk whose world is metric with +y up."""
    return export_world(data_set).startswith("metres, +y up")


def export_world(data_set: Path) -> str:
    """What an export of groundwalk says of its world; empty where it is none: other files of these kinds state no
    unit."""
    return str(read_json(data_set / EXPORT_NOTE).get("map", ""))


def _nested(data_set: Path, images: Path) -> bool:
    return (
        images != data_set and images.is_dir() and not _has_images(images) and any(p.is_dir() for p in images.iterdir())
    )


def _has_images(folder: Path) -> bool:
    return any(parsing.is_image(p) for p in folder.iterdir())
