"""RTAB-Map's export (the iOS app's among them): `<name>_camera_poses.txt` with `<name>_rgb/` and `<name>_calib/`.

By the tool's source, https://github.com/introlab/rtabmap (`rtabmap-export --images --poses_camera`). Poses are camera
to world with OpenCV's camera axes, in a map that loops optimised: a reference. Its +z is up, but exports are also known
with +y up, so up is unknown. Images have their number for a name, and so has the depth in `<name>_depth/`, which
RTAB-Map has of the image's own camera. A camera whose `distortion_model` is `equidistant` is a fisheye lens.
"""

import re
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import reference
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock

_POSES = "_camera_poses.txt"


def read(path: Path, limits: Limits) -> Recording:
    lists = parsing.in_order(path.glob(f"*{_POSES}"))
    poses, *others = [file for file in lists if not file.name.startswith(".")] or lists
    notes = [f"not read: {other.name}; put each export into a folder of its own" for other in others]
    name = poses.name.removesuffix(_POSES)
    image_of = parsing.by_stem(parsing.images_in(path / f"{name}_rgb"))

    def read_row(_: int, line: str) -> RawFrame:
        time_s, x, y, z, qx, qy, qz, qw, number = parsing.split_numbers(line, 9)
        image = image_of.get(f"{number:.0f}")
        if image is None:
            raise parsing.BadRow(f"{name}_rgb has no image {number:.0f}")
        return RawFrame(
            parsing.seconds_to_ns(time_s),
            parsing.quaternion_pose([x, y, z], [qx, qy, qz, qw]),
            ImageFile(image),
            _camera(path / f"{name}_calib" / f"{image.stem}.yaml"),
            number=int(number),
            depth=DepthFile.if_there(path / f"{name}_depth" / f"{image.stem}.png"),
        )

    frames, rejects = parsing.read_rows(parsing.lines_of(poses, limits), read_row)
    return reference("RTAB-Map", Clock.UNIX, path, frames, rejects, notes=notes)


def _camera(file: Path) -> Intrinsics:
    text = parsing.read_text(file)
    fx, _, cx, _, fy, cy, *_ = parsing.yaml_numbers(text, "camera_matrix", 9)
    width, height = (parsing.to_pixels(*parsing.yaml_numbers(text, f"image_{side}", 1)) for side in ("width", "height"))
    distortion = parsing.yaml_numbers(text, "distortion_coefficients")
    if len(distortion) < 4:
        raise parsing.BadRow(f"{file.name} has {len(distortion)} distortion_coefficients, not 4 or more")
    if re.search(r'^distortion_model:\s*"?(equidistant|fisheye)', text, re.M):
        if len(distortion) not in (4, 6):
            raise parsing.BadRow(f"{file.name} has {len(distortion)} distortion_coefficients, not 4 or 6 of a fisheye")
        k1, k2, *_, k3, k4 = distortion  # of 6, the two between are 0
        return parsing.fisheye_intrinsics((fx, fy, cx, cy), width, height, (k1, k2, k3, k4))
    return Intrinsics(fx, fy, cx, cy, width, height, tuple(distortion) if any(distortion) else ())


FORMAT = Format(
    id="rtabmap",
    label="RTAB-Map export",
    meaning="images, reference poses, depth",
    files=(f"*{_POSES}", "*_rgb/", "*_calib/"),
    read=read,
)
