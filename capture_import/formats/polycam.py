"""Polycam raw export: `keyframes/images/<t>.jpg` with `keyframes/cameras/<t>.json`.

https://github.com/PolyCam/polyform (README, "Polycam's data format"). Names are times in microseconds; `t_00` to `t_23`
are ARKit's camera to world, 3x4. `corrected_cameras` are optimised afterwards, no odometry, and aren't read. Depth
beyond 5 m is a guess; confidence is 0, 127 or 255.
"""

from pathlib import Path

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, ImageFile, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store.choices import Clock


def read(path: Path, limits: Limits) -> Recording:
    cameras = path / "keyframes" / "cameras"
    files = sorted((p for p in cameras.glob("*.json") if p.stem.isdecimal()), key=lambda p: int(p.stem))
    image_of = parsing.by_stem(parsing.images_in(path / "keyframes" / "images"))

    def read_row(_: int, file: Path) -> RawFrame:
        camera, image = parsing.parse_json(parsing.read_text(file)), image_of.get(file.stem)
        if int(file.stem) > parsing.MAX_NS // 1000:
            raise parsing.BadRow(f"name {file.stem} is no time")
        entries = [parsing.number(camera, f"t_{i}{j}") for i in range(3) for j in range(4)]
        depth = (path / "keyframes" / kind / f"{file.stem}.png" for kind in ("depth", "confidence"))
        return RawFrame(
            int(file.stem) * 1000,
            parsing.from_arkit(parsing.row_major_pose(entries)),
            ImageFile(image) if image else None,
            parsing.intrinsics(camera),
            depth=DepthFile.if_there(*depth),
        )

    frames, rejects = parsing.read_rows([(f"cameras/{file.name}", file) for file in files], read_row)
    notes = parsing.without_images(frames)
    return Recording("iOS, Polycam", Clock.BOOT, path, frames, rejects, notes=notes)


FORMAT = Format(
    id="polycam",
    label="Polycam raw",
    meaning="images, VIO, depth",
    files=("keyframes/cameras/", "keyframes/images/"),
    read=read,
)
