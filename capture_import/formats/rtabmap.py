"""RTAB-Map's export (the iOS app's among them): `<name>_camera_poses.txt` with `<name>_rgb/` and `<name>_calib/`.

Documented by the tool's source, https://github.com/introlab/rtabmap (`rtabmap-export --images --poses_camera`). What
matters:

- poses: time, x y z, qx qy qz qw and the image's number, camera to world with OpenCV's camera axes; the map that they
  lie in is optimised by loops: a reference, not VIO; its +z is up, but exports are also known with +y up, so up is
  unknown;
- images have their number for a name, `<name>_calib/<number>.yaml` is OpenCV's: camera_matrix, image_width and
  distortion_coefficients;
- `<name>_depth/` isn't read: it is in millimetres, but of another size and its own camera.
"""

from pathlib import Path

from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_files import by_stem, images_in, in_order
from groundwalk.capture_import.parsing import (
    BadRow,
    lines_of,
    quaternion_pose,
    read_rows,
    read_text,
    seconds_to_ns,
    split_numbers,
    to_pixels,
    yaml_numbers,
)
from groundwalk.store.choices import Clock, PoseSource

_POSES = "_camera_poses.txt"


def read(path: Path, limits: Limits) -> Recording:
    """Read the poses and join images and cameras by number."""
    poses = in_order(path.glob(f"*{_POSES}"))[0]
    name = poses.name.removesuffix(_POSES)
    image_of = by_stem(images_in(path / f"{name}_rgb"))

    def read_row(_: int, source: str, line: str) -> RawFrame:
        time_s, x, y, z, qx, qy, qz, qw, number = split_numbers(line, 9)
        image = image_of.get(f"{number:.0f}")
        if image is None:
            raise BadRow(f"{name}_rgb has no image {number:.0f}")
        return RawFrame(
            number=int(number),
            source=source,
            t_ns=seconds_to_ns(time_s),
            vio_T_cam=quaternion_pose([x, y, z], [qx, qy, qz, qw]),
            image=ImageFile(image),
            intrinsics=_camera(path / f"{name}_calib" / f"{image.stem}.yaml"),
        )

    frames, rejects = read_rows(lines_of(poses, limits), read_row)
    return Recording(
        "RTAB-Map",
        Clock.UNIX,
        path,
        frames,
        rejects,
        pose_source=PoseSource.REFERENCE,
        is_gravity_aligned=False,
    )


def _camera(file: Path) -> Intrinsics:
    text = read_text(file)

    fx, _, cx, _, fy, cy, *_ = yaml_numbers(text, "camera_matrix", 9)
    (width,), (height,) = (yaml_numbers(text, f"image_{side}", 1) for side in ("width", "height"))
    distortion = yaml_numbers(text, "distortion_coefficients")
    if len(distortion) < 4:
        raise BadRow(f"{file.name} has {len(distortion)} distortion_coefficients, not 4 or more")
    return Intrinsics(fx, fy, cx, cy, to_pixels(width), to_pixels(height), tuple(distortion) if any(distortion) else ())


FORMAT = Format(
    id="rtabmap",
    label="RTAB-Map export",
    meaning="images, reference poses",
    files=(f"*{_POSES}", "*_rgb/", "*_calib/"),
    read=read,
)
