"""ARKitScenes, raw part: `lowres_wide.traj` with images and intrinsics a frame.

https://github.com/apple/ARKitScenes/blob/main/DATA.md. Names are `<video>_<seconds>.png` and `.pincam`, seconds since
the device was started. A row of the trajectory is time, axis-angle rotation in radians and translation of the
world-to-camera transform, with OpenCV's camera axes in a world whose +z is up; it was refined with a laser scan, so
it's a reference. Depth and confidence have their image's name.
"""

from pathlib import Path

from scipy.spatial.transform import Rotation

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.poses import inverse, make_pose
from groundwalk.store.choices import Clock, PoseSource

# The best images that were downloaded.
_IMAGES = ("wide", "vga_wide", "lowres_wide")


def read(path: Path, limits: Limits) -> Recording:
    poses, rejects = parsing.read_rows(parsing.lines_of(path / "lowres_wide.traj", limits), _read_pose)
    folder = next(path / name for name in _IMAGES if (path / name).is_dir())
    files = [(f"{folder.name}/{file.name}", file) for file in parsing.images_in(folder)]
    images, more = parsing.read_rows(files, _read_image)
    frames = parsing.join_by_time(poses, images)
    return Recording("iPad Pro, ARKitScenes", Clock.BOOT, path, frames, [*rejects, *more], PoseSource.REFERENCE)


def _read_pose(_: int, line: str) -> RawFrame:
    time_s, rx, ry, rz, *translation = parsing.split_numbers(line, 7)
    cam_T_world = make_pose(Rotation.from_rotvec([rx, ry, rz]).as_matrix(), translation)
    return RawFrame(parsing.seconds_to_ns(time_s), parsing.YUP_T_ZUP @ inverse(cam_T_world))


def _read_image(_: int, image: Path) -> RawFrame:
    camera = image.parent.with_name(f"{image.parent.name}_intrinsics") / f"{image.stem}.pincam"
    width, height, fx, fy, cx, cy = parsing.split_numbers(parsing.read_text(camera), 6)
    return RawFrame(
        parsing.seconds_to_ns(parsing.to_number(image.stem.rpartition("_")[2], "name")),
        image=ImageFile(image),
        intrinsics=Intrinsics(fx, fy, cx, cy, parsing.to_pixels(width), parsing.to_pixels(height)),
        depth=DepthFile.if_there(*(image.parents[1] / kind / image.name for kind in ("lowres_depth", "confidence"))),
    )


FORMAT = Format(
    id="arkit_scenes",
    label="ARKitScenes raw",
    meaning="images, reference poses, depth",
    files=("lowres_wide.traj", "|".join(f"{name}/" for name in _IMAGES)),
    read=read,
)
