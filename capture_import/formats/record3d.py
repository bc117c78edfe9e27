"""Record3D: an `.r3d` archive (`metadata`, `rgbd/<n>.jpg`) or an exported folder (`metadata.json`, `rgb/<n>.jpg`).

https://record3d.app; the format by its files and https://github.com/marek-simonik/record3d. Poses are ARKit's camera to
world, quaternion first; `K` is column-major, `perFrameIntrinsicCoeffs` are fx fy cx cy. Images and poses belong
together by number; some exports have a few more of one. `rgbd/<n>.depth` is in metres as float32, row by row, `.conf` 0
to 2, both compressed by LZFSE (issues 7 and 93); a folder has `depth/<n>.exr`, metres as float32 in the red channel
(issue 53).
"""

from pathlib import Path
from typing import Any

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.depth import missing_decoder
from groundwalk.store import UserError
from groundwalk.store.choices import Clock


def read(path: Path, limits: Limits) -> Recording:
    metadata = path / "metadata" if (path / "metadata").is_file() else path / "metadata.json"
    images = path / "rgbd" if (path / "rgbd").is_dir() else path / "rgb"
    content = parsing.json_of(metadata, limits)
    poses = content.get("poses")
    if not isinstance(poses, list):
        raise UserError("Record3D's metadata has no poses", where=metadata, expected="poses: a list")
    times = content.get("frameTimestamps")
    files = {int(stem): image for stem, image in parsing.by_stem(parsing.images_in(images)).items() if stem.isdecimal()}
    depths = [p for p in (*images.glob("*.depth"), *(path / "depth").glob("*.exr")) if p.stem.isdecimal()]
    missing = missing_decoder(depths[0]) if depths else None
    depth_of = {} if missing else {int(p.stem): DepthFile.if_there(p, p.with_suffix(".conf")) for p in depths}

    def read_row(index: int, pose: Any) -> RawFrame:
        qx, qy, qz, qw, *t = parsing.to_numbers(pose, f"pose {index}", 7)
        return RawFrame(
            _time(content, times, index),
            parsing.from_arkit(parsing.quaternion_pose(t, [qx, qy, qz, qw])),
            ImageFile(files[index]) if index in files else None,
            _intrinsics(content, index),
            depth=depth_of.get(index),
        )

    frames, rejects = parsing.read_rows([(f"pose {i}", pose) for i, pose in enumerate(poses)], read_row)
    notes = [f"its depth isn't read: {missing}"] if missing else []
    if len(files) != len(poses):
        notes.append(f"{len(files)} images and {len(poses)} poses: joined by number")
    clock = Clock.VIDEO if isinstance(times, list) else Clock.FRAME_INDEX
    return Recording("iOS, Record3D", clock, path, frames, rejects, notes=notes)


def _time(content: dict[str, Any], times: object, index: int) -> int:
    if not isinstance(times, list):
        fps = parsing.number(content, "fps")
        if not 0 < fps < 1000:
            raise parsing.BadRow(f"fps {fps} is no frame rate")
        return parsing.seconds_to_ns(index / fps)
    if index >= len(times):
        raise parsing.BadRow("frame has no time")
    return parsing.seconds_to_ns(parsing.to_number(times[index], "frameTimestamps"))


def _intrinsics(content: dict[str, Any], index: int) -> Intrinsics:
    width, height = parsing.whole(content, "w"), parsing.whole(content, "h")
    per_frame = content.get("perFrameIntrinsicCoeffs")
    if isinstance(per_frame, list) and index < len(per_frame):
        fx, fy, cx, cy = parsing.to_numbers(per_frame[index], "row", 4).tolist()
    else:
        fx, _, _, _, fy, _, cx, cy, _ = parsing.numbers(content, "K", 9)
    return Intrinsics(fx, fy, cx, cy, width, height)


FORMAT = Format(
    id="record3d",
    label="Record3D",
    meaning="images, VIO, depth",
    files=("metadata|metadata.json", "rgbd/|rgb/"),
    looks_for="name.r3d, or metadata with rgbd/ or rgb/",
    read=read,
)
