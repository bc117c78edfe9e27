"""EuRoC's layout, which TUM-VI and others share: `mav0/cam0` with `mav0/state_groundtruth_estimate0`.

https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets. Times are in nanoseconds; ground truth
(TUM-VI: `mocap0`) is the body's, quaternion w first, in a world whose +z is up: a reference. `T_BS` of `cam0`'s
`sensor.yaml` is the camera in the body, with OpenCV's axes; its distortion is OpenCV's k1 k2 p1 p2 or, where
distortion_model is equidistant, its fisheye model's. `cam1` isn't read.
"""

import re
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.cameras import CENTRE_OF_FIRST_PIXEL
from groundwalk.store.choices import Clock, PoseSource

_TRUTH = ("mav0/state_groundtruth_estimate0/data.csv", "mav0/mocap0/data.csv")


def read(path: Path, limits: Limits) -> Recording:
    camera = path / "mav0" / "cam0"
    with parsing.refused("the camera can't be read", camera / "sensor.yaml"):
        text = parsing.read_text(camera / "sensor.yaml")
        body_T_cam = parsing.row_major_pose(parsing.yaml_numbers(text, "T_BS", 16))
        intrinsics = _intrinsics(text)

    def read_pose(place: int, line: str) -> RawFrame:
        t_ns, x, y, z, qw, qx, qy, qz, *_ = (*parsing.split_numbers(line, separator=","), *[float("nan")] * 8)
        world_T_body = parsing.quaternion_pose([x, y, z], [qx, qy, qz, qw])
        return RawFrame(parsing.seconds_to_ns(t_ns * 1e-9), parsing.YUP_T_ZUP @ world_T_body @ body_T_cam)

    def read_image(place: int, line: str) -> RawFrame:
        t_ns, _, name = line.partition(",")
        image = ImageFile(parsing.inside(camera / "data", name.strip()))
        time_ns = parsing.seconds_to_ns(parsing.to_number(t_ns, "time") * 1e-9)
        return RawFrame(time_ns, image=image, intrinsics=intrinsics)

    truth = next(path / name for name in _TRUTH if (path / name).is_file())
    poses, rejects = parsing.read_rows(parsing.lines_of(truth, limits), read_pose)
    images, more = parsing.read_rows(parsing.lines_of(camera / "data.csv", limits), read_image)
    rows = parsing.join_by_time(poses, images)
    return Recording("unknown", Clock.UNIX, path, rows, [*rejects, *more], pose_source=PoseSource.REFERENCE)


def _intrinsics(text: str) -> Intrinsics:
    fx, fy, *centre = parsing.yaml_numbers(text, "intrinsics", 4)
    cx, cy = (at + CENTRE_OF_FIRST_PIXEL for at in centre)
    width, height = (parsing.to_pixels(size) for size in parsing.yaml_numbers(text, "resolution", 2))
    distortion = tuple(parsing.yaml_numbers(text, "distortion_coefficients", 4))
    if re.search(r"^distortion_model:\s*equidistant", text, re.M):
        return parsing.fisheye_intrinsics((fx, fy, cx, cy), width, height, distortion)
    return Intrinsics(fx, fy, cx, cy, width, height, distortion)


FORMAT = Format(
    id="euroc",
    label="EuRoC",
    meaning="images, reference poses",
    files=("mav0/cam0/data.csv", "|".join(_TRUTH)),
    read=read,
)
