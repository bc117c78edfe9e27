"""TUM RGB-D's lists: `rgb.txt`, `groundtruth.txt` and, where it is there, `depth.txt`.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Poses are camera to world with OpenCV's camera axes, by
motion capture or whatever tool wrote the list: a reference, and nothing says where up is. `camera.txt` beside, which
isn't part of the format, may have fx fy cx cy (and k1 k2 p1 p2 k3); without it import finds the focal length. An
image has the depth that is nearest in time, as the benchmark's own tools associate them.
"""

from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import guessed_intrinsics, reference, size_of
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock

_DEPTH_UNITS_PER_M = 5000
_DEPTH_WITHIN_NS = 20_000_000


def read(path: Path, limits: Limits) -> Recording:
    def file_of(line: str) -> tuple[int, Path]:
        time, _, name = line.strip().partition(" ")
        return parsing.seconds_to_ns(parsing.to_number(time, "time")), parsing.inside(path, name.strip())

    def read_depth(_: int, line: str) -> RawFrame:
        t_ns, file = file_of(line)
        return RawFrame(t_ns, depth=DepthFile(file, units_per_m=_DEPTH_UNITS_PER_M))

    def read_image(_: int, line: str) -> RawFrame:
        t_ns, image = file_of(line)
        near = parsing.nearest(depths, t_ns, _DEPTH_WITHIN_NS)
        return RawFrame(
            t_ns,
            image=ImageFile(image),
            intrinsics=camera or guessed_intrinsics(*size_of(image)),
            depth=None if near is None else depths[near].depth,
        )

    camera, of_depth = camera_beside(path), path / "depth.txt"
    poses, rejects = parsing.read_rows(parsing.lines_of(path / "groundtruth.txt", limits), _read_pose)
    depths, no_depths = parsing.read_rows(parsing.lines_of(of_depth, limits) if of_depth.is_file() else [], read_depth)
    depths.sort(key=lambda depth: depth.t_ns)
    images, no_images = parsing.read_rows(parsing.lines_of(path / "rgb.txt", limits), read_image)
    frames, rejects = parsing.join_by_time(poses, images), [*rejects, *no_depths, *no_images]
    return reference("unknown", Clock.UNIX, path, frames, rejects, has_intrinsics=camera is not None)


def _read_pose(_: int, line: str) -> RawFrame:
    """A row of TUM's trajectory format; further numbers in it count for nothing."""
    values = parsing.split_numbers(line)
    if len(values) < 8:
        raise parsing.BadRow(f"row has {len(values)} numbers, not 8")
    return RawFrame(parsing.seconds_to_ns(values[0]), parsing.quaternion_pose(values[1:4], values[4:8]))


def camera_beside(folder: Path) -> Intrinsics | None:
    """What `camera.txt` in a folder states; None where there is none."""
    file = folder / "camera.txt"
    if not file.is_file():
        return None
    with parsing.refused("the camera can't be read", file, expected="fx fy cx cy"):
        fx, fy, cx, cy, *distortion = parsing.split_numbers(parsing.read_text(file))
        return Intrinsics(fx, fy, cx, cy, distortion=tuple(distortion))


FORMAT = Format(
    id="tum",
    label="TUM RGB-D lists",
    meaning="images, reference poses, depth",
    files=("rgb.txt", "groundtruth.txt"),
    read=read,
)
