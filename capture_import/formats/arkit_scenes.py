"""ARKitScenes, raw part: `lowres_wide.traj` with images and intrinsics a frame.

Documented at https://github.com/apple/ARKitScenes/blob/main/DATA.md. What matters:

- names are `<video>_<seconds>.png` and `.pincam`; times are seconds since the device was started;
- `lowres_wide.traj`, 10 rows a second: time, axis-angle rotation in radians and translation of the world-to-camera
  transform, with OpenCV's camera axes in a world whose +z is up;
- `.pincam`: width, height, fx, fy, cx, cy;
- the trajectory was refined with a laser scan: it's a reference, not the device's own odometry;
- `lowres_depth/<video>_<seconds>.png`: 16 bits, millimetres, 256x192, and `confidence/`: 0 to 2, of the frames whose
  images have the same name.
"""

from pathlib import Path

from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_files import images_in
from groundwalk.capture_import.joining import join_by_time
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    lines_of,
    read_text,
    refuse_unreadable,
    seconds_to_ns,
    split_numbers,
    to_number,
)
from groundwalk.geometry.poses import inverse, make_pose
from groundwalk.store.choices import Clock, PoseSource

# The best images that were downloaded.
_IMAGES = ("wide", "vga_wide", "lowres_wide")
_YUP_R_ZUP = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]


def detect(path: Path) -> bool:
    """A folder with lowres_wide.traj and one of the image folders."""
    return (path / "lowres_wide.traj").is_file() and any((path / name).is_dir() for name in _IMAGES)


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the trajectory and the images; poses are interpolated where an image lies between two rows."""
    poses, rejects = collect(lines_of(path / "lowres_wide.traj", limits), session_id, _read_pose)
    refuse_unreadable(path, poses, rejects, "time, rotation (3), translation (3) a row")
    folder = next(path / name for name in _IMAGES if (path / name).is_dir())
    cameras = folder.with_name(folder.name + "_intrinsics")
    files = images_in(folder)
    rows = [(f"{folder.name}/{file.name}", (file, cameras / f"{file.stem}.pincam")) for file in files]
    images, more = collect(rows, session_id, _read_image)
    return RawSession(
        session_id,
        FORMAT.id,
        "iPad Pro, ARKitScenes",
        Clock.BOOT,
        path,
        join_by_time(poses, images),
        [*rejects, *more],
        pose_source=PoseSource.REFERENCE,
    )


def _read_pose(source: str, line: str) -> RawFrame:
    values = split_numbers(line)
    if len(values) != 7:
        raise BadRow(f"row has {len(values)} numbers, not 7")
    cam_T_world = make_pose(Rotation.from_rotvec(values[1:4]).as_matrix(), values[4:])
    world_T_cam = make_pose(_YUP_R_ZUP, [0.0, 0.0, 0.0]) @ inverse(cam_T_world)
    return RawFrame(0, source, seconds_to_ns(values[0]), world_T_cam)


def _read_image(source: str, files: tuple[Path, Path]) -> RawFrame:
    image, camera = files
    values = split_numbers(read_text(camera, 1 << 16))
    if len(values) != 6 or not all(0 < size < 1e6 for size in values[:2]):
        raise BadRow(f"{camera.name} isn't width, height, fx, fy, cx, cy")
    return RawFrame(
        number=0,
        source=source,
        t_ns=seconds_to_ns(to_number(image.stem.rpartition("_")[2], "name")),
        vio_T_cam=None,
        image=ImageFile(image),
        intrinsics=Intrinsics.of(values[2:], width=int(values[0]), height=int(values[1])),
        depth=DepthFile.if_there(*(image.parents[1] / kind / image.name for kind in ("lowres_depth", "confidence"))),
    )


FORMAT = Format(
    id="arkit_scenes",
    label="ARKitScenes raw",
    meaning="images, reference poses, depth",
    looks_for="lowres_wide.traj with wide/, vga_wide/ or lowres_wide/",
    detect=detect,
    read=read,
)
