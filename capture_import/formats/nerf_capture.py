"""NeRFCapture: `transforms.json` with `images/<n>.png`.

By the app's source, https://github.com/jc211/NeRFCapture. `timestamp` is in seconds since the phone was started,
`transform_matrix` ARKit's camera to world, which is what NeRF tools call OpenGL axes. Frames aren't always in the order
of time. `depth_path` isn't read: versions differ in what they write there. Without times it's format `nerfstudio`.
"""

from pathlib import Path
from typing import Any

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import ImageFile, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.store import UserError
from groundwalk.store.choices import Clock
from groundwalk.store.hints import setting_of


def detect(path: Path) -> bool:
    return (path / "images").is_dir() and b'"timestamp"' in parsing.first_bytes(path / "transforms.json")


def read(path: Path, limits: Limits) -> Recording:
    rows = parsing.json_of(path / "transforms.json", limits).get("frames")
    if not isinstance(rows, list) or not any(isinstance(row, dict) and "timestamp" in row for row in rows):
        raise UserError(
            "transforms.json isn't NeRFCapture's",
            where=path,
            expected="frames with a timestamp each",
            found="no timestamps" if rows else "no frames",
            do="poses from SfM aren't VIO: import the phone's own recording, or set "
            + setting_of("import", 'format = "nerfstudio"'),
        )

    def read_row(_: int, row: Any) -> RawFrame:
        if not isinstance(row, dict):
            raise parsing.BadRow("frame is no object")
        image = parsing.inside(path, row.get("file_path"))
        if not image.suffix or not image.exists():
            image = image.with_name(image.name + ".png")
        return RawFrame(
            parsing.seconds_to_ns(parsing.number(row, "timestamp"), "timestamp"),
            parsing.from_arkit(parsing.row_major_pose(parsing.numbers(row, "transform_matrix", 16))),
            ImageFile(image),
            parsing.intrinsics(row, ("fl_x", "fl_y", "cx", "cy"), ("w", "h")),
        )

    frames, rejects = parsing.read_rows([(f"frame {i}", row) for i, row in enumerate(rows)], read_row)
    return Recording("iOS, NeRFCapture", Clock.BOOT, path, parsing.join_by_time([], frames), rejects)


FORMAT = Format(
    id="nerf_capture",
    label="NeRFCapture",
    meaning="images, VIO",
    files=("transforms.json", "images/"),
    detect=detect,
    looks_for="transforms.json with times, and images/",
    read=read,
)
