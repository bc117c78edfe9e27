"""3D Scanner App (Laan Labs), export "All Data": one `frame_XXXXX.json` a pose, one JPEG for some of them.

https://3dscannerapp.com, and files from versions 1.9.5 and 1.9.7. `cameraPoseARFrame` is ARKit's camera to world in row
order, `intrinsics` are for the full image, whose size follows from them and the `projectionMatrix` (OpenGL's). Depth is
256x192 for the whole image, in millimetres, `conf_XXXXX.png` ARKit's confidence, 0 to 2; its maker documents neither.
Latitude and longitude in the frames, without an accuracy, are read only where import is asked for GPS.
"""

import re
from functools import partial
from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import (
    DepthFile,
    GpsFix,
    ImageFile,
    Intrinsics,
    Limits,
    RawFrame,
    Recording,
    Reject,
)
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock

_FRAME = re.compile(r"frame_(\d{1,9})\.json")


def read(path: Path, limits: Limits) -> Recording:
    numbered = sorted((int(m[1]), p) for p in path.iterdir() if (m := _FRAME.fullmatch(p.name)))
    files = dict(reversed(numbered))
    image_of = parsing.by_stem(parsing.images_in(path))

    def read_frame(_: int, numbered_file: tuple[int, Path]) -> RawFrame:
        number, file = numbered_file
        row, digits = parsing.parse_json(parsing.read_text(file)), file.stem.removeprefix("frame_")
        image = image_of.get(file.stem)
        return RawFrame(
            parsing.seconds_to_ns(parsing.number(row, "time")),
            parsing.from_arkit(parsing.row_major_pose(parsing.numbers(row, "cameraPoseARFrame", 16))),
            ImageFile(image) if image else None,
            _intrinsics(row),
            exposure_s=parsing.optional_number(row, "exposureDuration"),
            depth=DepthFile.if_there(path / f"depth_{digits}.png", path / f"conf_{digits}.png"),
            number=number,
        )

    frames, rejects = parsing.read_rows([(file.name, (i, file)) for i, file in sorted(files.items())], read_frame)
    rejects += [
        Reject(file.name, None, f"{files[index].name} has the same frame number")
        for index, file in numbered
        if file != files[index]
    ]
    rows = [(file.name, file) for _, file in sorted(files.items())]
    read_gps = partial(parsing.read_fixes, rows, _read_fix)
    return Recording(_device(path), Clock.BOOT, path, frames, rejects, read_gps=read_gps)


def _read_fix(_: int, file: Path) -> GpsFix | None:
    row = parsing.parse_json(parsing.read_text(file))
    if "latitude" not in row or "longitude" not in row:
        return None
    place = [parsing.number(row, name) for name in ("latitude", "longitude")]
    return GpsFix(parsing.seconds_to_ns(parsing.number(row, "time")), *place)


def _intrinsics(row: dict[str, object]) -> Intrinsics:
    fx, _, cx, _, fy, cy, *_ = parsing.numbers(row, "intrinsics", 9)
    width = height = None
    if "projectionMatrix" in row:
        projection = parsing.numbers(row, "projectionMatrix", 16)
        if min(projection[0], projection[5]) > 1e-6 and max(fx, fy) < 1e9:
            width, height = _pixels(2 * fx / projection[0]), _pixels(2 * fy / projection[5])
    return Intrinsics(fx, fy, cx, cy, width, height)


def _pixels(value: float) -> int | None:
    return round(value) if 0 < value < 1e6 else None


def _device(path: Path) -> str:
    try:
        version = parsing.parse_json(parsing.read_text(path / "info.json")).get("appVersionString")
    except parsing.BadRow:
        return "unknown"
    return f"iOS, 3D Scanner App {version}" if isinstance(version, str) else "iOS"


FORMAT = Format(
    id="3d_scanner_app",
    label="3D Scanner App",
    meaning="images, VIO, depth",
    files=("frame_[0-9]*.json",),
    looks_for="frame_XXXXX.json with frame_XXXXX.jpg for some of them",
    read=read,
)
