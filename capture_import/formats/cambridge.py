"""Cambridge Landmarks: `dataset_train.txt` and `dataset_test.txt` over folders of images, each of which is a recording.

https://www.repository.cam.ac.uk/handle/1810/251342 (readme). A row is an image's path, the camera's position in metres,
and a quaternion w, x, y, z of the world-to-camera rotation, with OpenCV's camera axes, by SfM: a reference, and nothing
says where up is. `reconstruction.nvm` (VisualSFM) has each image's focal length; `frames.csv`, which our own exports
write beside, has whole intrinsics and goes before it. Frames have no times, and the order of names isn't always one of
time.
"""

import csv
import math
import re
from dataclasses import replace
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import NO_DISTORTION, reference, size_of
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, SessionSplit

_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
_LISTS = {"dataset_train.txt": SessionSplit.TRAIN, "dataset_test.txt": SessionSplit.TEST}


def detect(path: Path) -> bool:
    has_list = any((path.parent / name).is_file() for name in _LISTS)
    return path.is_dir() and has_list and any(parsing.is_image(p) for p in path.iterdir())


def read(path: Path, limits: Limits) -> Recording:
    rows: list[tuple[str, tuple[SessionSplit, str]]] = []
    for name, split in _LISTS.items():
        if (file := path.parent / name).is_file():
            lines = parsing.lines_of(file, limits, lambda line: line.startswith(f"{path.name}/"))
            rows += [(source, (split, line)) for source, line in lines]
    focal = _focal_lengths(path.parent / "reconstruction.nvm", path.name, limits)
    cameras = _intrinsics(path.parent / "frames.csv", path.name, limits)

    def read_row(place: int, row: tuple[SessionSplit, str]) -> RawFrame:
        split, line = row
        name, _, numbers = line.strip().partition(" ")
        x, y, z, qw, qx, qy, qz = parsing.split_numbers(numbers, 7)
        number = re.search(r"(\d{1,9})\.", name)
        if number is None:
            raise parsing.BadRow("row isn't an image's path and 7 numbers")
        f = focal.get(Path(name).stem)
        if f is None:
            raise parsing.BadRow("image isn't in reconstruction.nvm")
        cam_R_world = parsing.quaternion_pose([0.0, 0.0, 0.0], [qx, qy, qz, qw])[:3, :3]
        image = parsing.inside(path.parent, name)
        width, height = size_of(image)
        return RawFrame(
            parsing.seconds_to_ns(int(number[1])),
            make_pose(cam_R_world.T, [x, y, z]),
            ImageFile(image),
            cameras.get(name) or Intrinsics(f, f, width / 2, height / 2, width, height),
            split=split,
            number=int(number[1]),
        )

    frames, rejects = parsing.read_rows(rows, read_row)
    frames.sort(key=lambda frame: frame.number)
    return reference("Cambridge Landmarks", Clock.NAME_ORDER, path, frames, rejects)


def _focal_lengths(file: Path, folder: str, limits: Limits) -> dict[str, float]:
    """Focal lengths in pixels by the image's name without suffix, of one folder."""
    if not file.is_file():
        raise UserError(
            "reconstruction.nvm is missing", where=file, do="it comes with the data set; it has the focal lengths"
        )
    by_name = {}
    for _, line in parsing.lines_of(file, limits, lambda line: line.lstrip().startswith(f"{folder}/")):
        fields = line.split()
        # A camera's row: name, focal length, quaternion, centre, radial distortion, 0.
        if len(fields) == 11:
            value = float(fields[1]) if re.fullmatch(r"[0-9.]+(e[+-]?\d+)?", fields[1]) else math.nan
            by_name[Path(fields[0]).stem] = value
    return by_name


def _intrinsics(file: Path, folder: str, limits: Limits) -> dict[str, Intrinsics]:
    """Whole intrinsics by the image's path, of one folder, where our export has written them; none where it's another
    file."""
    if not file.is_file():
        return {}
    lines = parsing.lines_of(file, limits, lambda line: line.startswith("frame_id,") or f"{folder}/" in line)
    rows = csv.DictReader(line for _, line in lines)
    if not {"image", *_CAMERA, "distortion"} <= set(rows.fieldnames or ()):
        return {}
    try:
        return {
            row["image"]: replace(
                parsing.intrinsics(row),
                distortion=tuple(parsing.split_numbers(row["distortion"] or "")) or NO_DISTORTION,
            )
            for row in rows
            if row["image"]
        }
    except (parsing.BadRow, csv.Error) as error:
        raise UserError(
            "an export's cameras can't be read",
            where=file,
            expected=f"{', '.join(_CAMERA)} of each image",
            found=error,
            do="export the scene again",
        ) from None


FORMAT = Format(
    id="cambridge",
    label="Cambridge Landmarks",
    meaning="images, reference poses",
    files=("dataset_train.txt|dataset_test.txt", "reconstruction.nvm"),
    looks_for="a folder of images beside dataset_train.txt and reconstruction.nvm",
    detect=detect,
    read=read,
)
