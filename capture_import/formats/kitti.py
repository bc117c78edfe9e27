"""KITTI odometry: a sequence's `image_2/` (or `image_0/`) with `times.txt`, `calib.txt` and a file of poses.

https://www.cvlibs.net/datasets/kitti/eval_odometry.php, and the development kit. A pose is a 3x4 matrix in row order,
from the left grey camera (0) to where it was at the first image, with OpenCV's camera axes: a reference whose up isn't
known. Row n is of image n and of row n of `times.txt`, in seconds. Poses lie in `poses/<sequence>.txt` beside
`sequences/`, or in the sequence's `poses.txt`, as evo's users have them. `P0` to `P3` of `calib.txt` are the pinholes
of the rectified images, times their place beside camera 0.
"""

from pathlib import Path

import numpy as np

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import reference
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.cameras import CENTRE_OF_FIRST_PIXEL
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store import UserError
from groundwalk.store.choices import Clock

_FOLDERS = ("image_2", "image_0")


def _poses_of(path: Path) -> Path:
    of_data_set = path.parent.parent / "poses" / f"{path.name}.txt"
    return of_data_set if of_data_set.is_file() and path.parent.name == "sequences" else path / "poses.txt"


def detect(path: Path) -> bool:
    names = [path / "calib.txt", path / "times.txt", _poses_of(path)]
    return all(name.is_file() for name in names) and any((path / folder).is_dir() for folder in _FOLDERS)


def read(path: Path, limits: Limits) -> Recording:
    folder = next(path / name for name in _FOLDERS if (path / name).is_dir())
    camera, cam0_T_cam = _camera(path / "calib.txt", f"P{folder.name[-1]}", limits)
    times = [line for _, line in parsing.lines_of(path / "times.txt", limits)]
    by_stem = parsing.by_stem(parsing.images_in(folder))
    image_of = {int(stem): image for stem, image in by_stem.items() if stem.isdecimal()}

    def read_row(place: int, line: str) -> RawFrame:
        if place >= len(times):
            raise parsing.BadRow("times.txt has no such row")
        pose = parsing.row_major_pose(parsing.split_numbers(line, 12))
        if not (np.abs(pose) < 1e100).all():
            raise parsing.BadRow("pose has a value that isn't finite or is too large")
        return RawFrame(
            parsing.seconds_to_ns(parsing.to_number(times[place].strip(), "time")),
            pose @ cam0_T_cam,
            ImageFile(image_of[place]) if place in image_of else None,
            camera,
        )

    frames, rejects = parsing.read_rows(parsing.lines_of(_poses_of(path), limits), read_row)
    return reference("KITTI", Clock.VIDEO, path, frames, rejects, notes=parsing.without_images(frames))


def _camera(file: Path, name: str, limits: Limits) -> tuple[Intrinsics, Array]:
    """A camera's pinhole, and its place in camera 0 (4, 4)."""
    for _, line in parsing.lines_of(file, limits, lambda line: line.startswith(f"{name}:")):
        try:
            p = parsing.row_major_pose(parsing.split_numbers(line.partition(":")[2], 12))[:3]
            fx, fy, cx, cy = (float(p[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
            if not (np.isfinite(p).all() and min(fx, fy) > 0):
                raise parsing.BadRow("no focal length above 0")
        except parsing.BadRow as error:
            raise UserError("the camera can't be read", where=file, found=f"{name}: {error}") from None
        x, y, z = p[:, 3].tolist()
        place = make_pose(np.eye(3), [-(x - cx * z) / fx, -(y - cy * z) / fy, -z])
        return Intrinsics(fx, fy, cx + CENTRE_OF_FIRST_PIXEL, cy + CENTRE_OF_FIRST_PIXEL), place
    raise UserError("the camera can't be read", where=file, expected=f"a line that begins with {name}:")


FORMAT = Format(
    id="kitti",
    label="KITTI odometry",
    meaning="images, reference poses",
    files=("calib.txt", "times.txt", "image_2/|image_0/", "poses.txt"),
    looks_for="calib.txt, times.txt and image_2/ or image_0/, with poses.txt or ../../poses/<sequence>.txt",
    detect=detect,
    read=read,
)
