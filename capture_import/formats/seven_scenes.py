"""7-Scenes (Microsoft): `seq-XX/frame-000000.color.png` with `frame-000000.pose.txt`.

https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes. Poses are camera to world with OpenCV's camera
axes, by KinectFusion: a reference, and nothing says where up is. Frames have no times; the camera took 30 a second (our
own exports number frames anew). The colour camera wasn't calibrated: its nominal focal length is used, or
`frame-000000.intrinsics.txt`, which our own exports write. Depth is of another camera, and isn't read.
"""

import re
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.data_sets import NO_DISTORTION, export_world, reference
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock, SessionSplit

_POSE = re.compile(r"frame-(\d{6})\.pose\.txt")
_FRAMES_A_SECOND = 30.0
_CAMERA = Intrinsics(525.0, 525.0, 320.0, 240.0, 640, 480)


def read(path: Path, limits: Limits) -> Recording:
    files = sorted((int(m[1]), p) for p in path.iterdir() if (m := _POSE.fullmatch(p.name)))
    image_of = parsing.by_stem(parsing.images_in(path))
    ours = bool(export_world(path.parent))

    def read_row(_: int, numbered_file: tuple[int, Path]) -> RawFrame:
        number, file = numbered_file
        image = image_of.get(f"frame-{number:06d}.color")
        return RawFrame(
            parsing.seconds_to_ns(number / _FRAMES_A_SECOND),
            parsing.row_major_pose(parsing.split_numbers(parsing.read_text(file), 16)),
            ImageFile(image) if image else None,
            _camera(path / f"frame-{number:06d}.intrinsics.txt", NO_DISTORTION if ours else ()),
            number=number,
        )

    frames, rejects = parsing.read_rows([(file.name, (number, file)) for number, file in files], read_row)
    split, notes = _split(path), list[str]()
    if split is None:
        notes.append(
            "no split: TrainSplit.txt and TestSplit.txt beside its folder don't list it; if it's zipped, unpack it"
        )
    if any(frame.intrinsics is _CAMERA for frame in frames):
        notes.append("nominal intrinsics: the colour camera wasn't calibrated")
    notes += parsing.without_images(frames)
    clock = Clock.NAME_ORDER if ours else Clock.FRAME_INDEX
    return reference("Kinect", clock, path, frames, rejects, split=split, notes=notes)


def _camera(file: Path, distortion: tuple[float, ...]) -> Intrinsics:
    if not file.exists():
        return _CAMERA
    fx, _, cx, _, fy, cy, *_ = parsing.split_numbers(parsing.read_text(file), 9)
    return Intrinsics(fx, fy, cx, cy, distortion=distortion)


def _split(path: Path) -> SessionSplit | None:
    number = re.search(r"(\d+)$", path.name)
    for name, split in (("TrainSplit.txt", SessionSplit.TRAIN), ("TestSplit.txt", SessionSplit.TEST)):
        try:
            listed = re.findall(r"sequence(\d+)", parsing.read_text(path.parent / name))
        except parsing.BadRow:
            continue
        if number and int(number[1]) in map(int, listed):
            return split
    return None


FORMAT = Format(
    id="seven_scenes",
    label="7-Scenes",
    meaning="images, reference poses",
    files=("frame-[0-9]*.pose.txt",),
    looks_for="frame-000000.color.png and frame-000000.pose.txt",
    read=read,
)
