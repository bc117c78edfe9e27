"""Images beside one list of their poses, as SLAM systems, COLMAP's helpers and evo's users keep them.

A list is named as trajectories are (`CameraTrajectory.txt`, `poses.txt`, `walk.tum`), and a row of it is TUM's (time in
seconds, position, quaternion xyzw), KITTI's (a 3x4 matrix in row order), or an image's name with position and
quaternion; all are camera to world with OpenCV's camera axes. TUM's rows belong to images whose names are times, in
seconds, milli-, micro- or nanoseconds; else rows and images, if equal in number, belong together by their order.
Whose poses they are nothing says: a reference, whose up isn't known. `camera.txt` is read as beside TUM's lists.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import guessed_intrinsics, reference, size_of
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.formats.tum import camera_beside
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.choices import Clock

_LIST = re.compile(r".*(traj|pose|groundtruth|ground_truth).*\.txt|.*\.tum", re.IGNORECASE)
_FOLDERS = ("images", "rgb", "frames", "color", "photos", "input", ".")
_MIN_IMAGES = 3
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # of times in images' names, seconds
_TIME_NAME = re.compile(r"\d+\.\d+|[1-9]\d{9,}")  # KITTI numbers images by ten digits, from 0000000000
_NANOSECONDS = 1e17  # a time that is larger is since 1970 in nanoseconds
_TIME, _MATRIX, _NAME = "time", "matrix", "name"


def _kind(line: str) -> str | None:
    """What a row of a list begins with; None for one of something else."""
    words = line.split()
    numbers = sum(_is_number(word) for word in words)
    by_count = {(8, 8): _TIME, (12, 12): _MATRIX, (8, 7): _NAME}
    found = by_count.get((len(words), numbers))
    return None if found == _NAME and _is_number(words[0]) else found


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _lists(folder: Path) -> Iterator[tuple[Path, str]]:
    """The lists of poses in a folder, with what their rows begin with: nothing in an empty one."""
    for path in sorted(folder.iterdir()):
        if _LIST.fullmatch(path.name) and path.is_file():
            lines = parsing.first_bytes(path, 1 << 12).decode("utf-8-sig", "replace").splitlines()
            row = next((line for line in lines if line.strip() and not line.startswith("#")), "")
            if not row:
                yield path, ""
            elif kind := _kind(row):
                yield path, kind


def _images(folder: Path) -> list[Path]:
    found = (parsing.images_in(folder / name) for name in _FOLDERS if (folder / name).is_dir())
    return next((images for images in found if len(images) >= _MIN_IMAGES), [])


def detect(path: Path) -> bool:
    return path.is_dir() and next(_lists(path), None) is not None and bool(_images(path))


def read(path: Path, limits: Limits) -> Recording:
    lists = {file: (kind, parsing.lines_of(file, limits)) for file, kind in _lists(path)}
    file = max(lists, key=lambda file: len(lists[file][1]))
    kind, rows = lists[file]
    if not rows:
        raise UserError("a list of poses is empty", where=file, do="take it away to read the images without poses")
    images, camera = _images(path), camera_beside(path)
    notes = [f"not read, as {file.name} has more poses: {other.name}" for other in lists if other != file]
    stated = {"has_intrinsics": camera is not None, "notes": notes}

    def frame_of(seconds: float, image: Path, pose: Array | None = None) -> RawFrame:
        size = size_of(image)
        return RawFrame(parsing.seconds_to_ns(seconds), pose, ImageFile(image), camera or guessed_intrinsics(*size))

    if kind == _TIME and (timed := _times(images, rows)):
        poses, rejects = parsing.read_rows(rows, lambda _, line: RawFrame(*_timed_pose(line)))
        named = [(image.name, (image, seconds)) for image, seconds in zip(images, timed, strict=True)]
        of_images, more = parsing.read_rows(named, lambda _, row: frame_of(row[1], row[0]))
        frames = parsing.join_by_time(poses, of_images)
        return reference("unknown", Clock.UNIX, path, frames, [*rejects, *more], **stated)

    if kind != _NAME and len(rows) != len(images):
        raise UserError(
            "a list of poses and the images beside it don't belong together",
            where=file,
            expected="as many images as rows" + ", or images named by the list's times" * (kind == _TIME),
            found=f"{len(rows)} rows, {len(images)} images, such as {images[0].name}",
        )
    image_of = {image.name: image for image in images} | parsing.by_stem(images)

    def read_row(place: int, line: str) -> RawFrame:
        if kind == _TIME:
            return frame_of(place, images[place], _timed_pose(line)[1])
        if kind == _MATRIX:
            return frame_of(place, images[place], parsing.row_major_pose(parsing.split_numbers(line, 12)))
        name, _, rest = line.strip().partition(" ")
        if (image := image_of.get(Path(name).name)) is None:
            raise parsing.BadRow(f"there is no image {name}")
        values = parsing.split_numbers(rest, 7)
        return frame_of(place, image, parsing.quaternion_pose(values[:3], values[3:]))

    frames, rejects = parsing.read_rows(rows, read_row)
    return reference("unknown", Clock.NAME_ORDER, path, frames, rejects, **stated)


def _timed_pose(line: str) -> tuple[int, Array]:
    """Time, ns, and pose of a row of TUM's list, whose time some systems write in nanoseconds."""
    values = parsing.split_numbers(line, 8)
    return parsing.seconds_to_ns(_seconds(values[0])), parsing.quaternion_pose(values[1:4], values[4:])


def _seconds(time: float) -> float:
    return time * 1e-9 if time > _NANOSECONDS else time


def _times(images: Sequence[Path], rows: Sequence[tuple[str, str]]) -> list[float] | None:
    """The times of images, seconds, by their names, in the unit in which most lie within the list's; None where the
    names, as those of images that are numbered, are no times, or none lies there."""
    stems = [image.stem for image in images]
    listed = [_seconds(float(word)) for word in (line.split()[0] for _, line in rows) if _is_number(word)]
    if not listed or not all(_TIME_NAME.fullmatch(stem) for stem in stems):
        return None

    def inside(unit: float) -> int:
        return sum(min(listed) - 0.05 <= unit * float(stem) <= max(listed) + 0.05 for stem in stems)

    unit = max(_UNITS, key=inside)
    return [unit * float(stem) for stem in stems] if inside(unit) else None


FORMAT = Format(
    id="pose_list",
    label="images with a list of poses",
    meaning="images, reference poses",
    files=(),
    looks_for="images beside a list of poses: rows of TUM, KITTI, or image name, position, quaternion",
    detect=detect,
    read=read,
    yields_to=("colmap", "nerfstudio", "llff"),
    yields_to_all=True,
)
