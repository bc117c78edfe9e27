"""Polycam raw export: `keyframes/images/<t>.jpg` with `keyframes/cameras/<t>.json`.

Documented at https://github.com/PolyCam/polyform (README, "Polycam's data format"). What matters:

- a file's name is its time in microseconds;
- `t_00` .. `t_23`: 3x4, row-major, ARKit's camera to world (y up, z backward);
- `cameras` are the phone's poses; `corrected_cameras` are optimised afterwards and are no odometry: they aren't read;
- `images` are as the camera took them, with the little distortion that is left in a phone's images;
- `depth/<t>.png`: 16 bits, millimetres, of a lower resolution than the image; beyond 5 m it's a guess;
  `confidence/<t>.png`: 0 (low), 127 (medium) or 255 (high).
"""

from pathlib import Path

from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, RawSession
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_files import by_stem, images_in, size_notes, unused
from groundwalk.capture_import.parsing import (
    BadRow,
    collect,
    from_arkit,
    number,
    optional_size,
    parse_json,
    read_text,
    refuse_unreadable,
    row_major_pose,
)
from groundwalk.store.choices import Clock

_MAX_FRAME_BYTES = 1 << 20
_LATEST_US = 2**62 // 1000


def detect(path: Path) -> bool:
    """A folder with keyframes/cameras and keyframes/images."""
    return (path / "keyframes" / "cameras").is_dir() and (path / "keyframes" / "images").is_dir()


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the camera files in the order of their times and join images by name."""
    cameras, images = path / "keyframes" / "cameras", path / "keyframes" / "images"
    files = sorted((p for p in cameras.glob("*.json") if p.stem.isdecimal()), key=lambda p: int(p.stem))
    image_of = by_stem(images_in(images))
    rows = [(f"cameras/{file.name}", (i, file, image_of.get(file.stem))) for i, file in enumerate(files)]
    frames, rejects = collect(rows, session_id, _read_row)
    refuse_unreadable(path, frames, rejects, "keyframes/cameras/<microseconds>.json with t_00 .. t_23, fx, fy, cx, cy")
    used = {image for _, (_, _, image) in rows}
    rejects += unused(session_id, images_in(images), used, "image has no camera file of its own with its name")
    notes = size_notes(frames)
    return RawSession(session_id, FORMAT.id, "iOS, Polycam", Clock.BOOT, path, frames, rejects, notes=notes)


def _read_row(source: str, row: tuple[int, Path, Path | None]) -> RawFrame:
    index, file, image = row
    camera = parse_json(read_text(file, _MAX_FRAME_BYTES))
    if int(file.stem) > _LATEST_US:
        raise BadRow(f"name {file.stem} is no time")
    entries = [number(camera, f"t_{i}{j}") for i in range(3) for j in range(4)]
    return RawFrame(
        number=index,
        source=source,
        t_ns=int(file.stem) * 1000,
        vio_T_cam=from_arkit(row_major_pose(entries)),
        image=ImageFile(image) if image else None,
        intrinsics=Intrinsics.of(
            (number(camera, key) for key in ("fx", "fy", "cx", "cy")),
            *optional_size(camera, "width", "height"),
        ),
        depth=DepthFile.if_there(
            *(file.parents[1] / kind / f"{file.stem}.png" for kind in ("depth", "confidence")),
        ),
    )


FORMAT = Format(
    id="polycam",
    label="Polycam raw",
    meaning="images, VIO, depth",
    looks_for="keyframes/cameras and keyframes/images",
    detect=detect,
    read=read,
)
