"""Our own format: `frames.jsonl`, one JSON object a line, with images beside it.

docs/reference/capture-formats.md describes it.
The first line says what the recording is, each other line is one instant:

    {"groundwalk": "frames", "version": 1, "device": "iPhone 14 Pro", "clock": "boot"}
    {"t_ns": 5000100000000, "image": "images/000001.jpg", "vio_T_cam": [...16 numbers...],
     "fx": 1447.6, "fy": 1447.6, "cx": 966.0, "cy": 691.7, "width": 1920, "height": 1440, "tracking": "normal"}
"""

from pathlib import Path
from typing import Any

from groundwalk.capture_import.capture import (
    DepthFile,
    ImageFile,
    Intrinsics,
    Limits,
    RawFrame,
    RawSession,
    Reject,
)
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.image_files import in_order, is_image, size_notes, unused
from groundwalk.capture_import.parsing import (
    MAX_NS,
    BadRow,
    collect,
    inside,
    lines_of,
    number,
    numbers,
    optional_number,
    optional_size,
    parse_json,
    refuse_unreadable,
    row_major_pose,
    to_number,
)
from groundwalk.geometry.shutter import MAX_READOUT_S
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, ImageSide, Tracking, UpSource

_VERSION = 1
_CLOCKS = [clock for clock in Clock if clock.has_times]


def detect(path: Path) -> bool:
    """A folder with frames.jsonl."""
    return (path / "frames.jsonl").is_file()


def read(path: Path, session_id: str, limits: Limits) -> RawSession:
    """Read the header and the rows."""
    lines = lines_of(path / "frames.jsonl", limits)
    header = _header(path, lines[0][1] if lines else "")

    def read_row(source: str, line: tuple[int, str]) -> RawFrame:
        index, text = line
        row = parse_json(text)
        t_ns = row.get("t_ns")
        if not isinstance(t_ns, int) or abs(t_ns) > MAX_NS:
            raise BadRow("t_ns is no whole number of nanoseconds")
        tracking = row.get("tracking", Tracking.UNKNOWN)
        if tracking not in [*Tracking]:
            raise BadRow(f"tracking is none of {', '.join(Tracking)}")
        return RawFrame(
            number=index,
            source=source,
            t_ns=t_ns,
            vio_T_cam=row_major_pose(numbers(row, "vio_T_cam", 16)) if row.get("vio_T_cam") is not None else None,
            image=ImageFile(inside(path, row["image"])) if row.get("image") is not None else None,
            intrinsics=_intrinsics(row) if row.get("image") is not None else None,
            tracking=Tracking(tracking),
            exposure_s=optional_number(row, "exposure_s"),
            depth=_depth(path, row) if row.get("depth") is not None else None,
        )

    rows = [(source, (i, line)) for i, (source, line) in enumerate(lines[1:])]
    frames, rejects = collect(rows, session_id, read_row)
    refuse_unreadable(path, frames, rejects, "rows with t_ns, vio_T_cam, image and intrinsics")
    rejects += _unnamed(path, session_id, frames)
    return RawSession(
        session_id, FORMAT.id, folder=path, frames=frames, rejects=rejects, notes=size_notes(frames), **header
    )


def _unnamed(path: Path, session_id: str, frames: list[RawFrame]) -> list[Reject]:
    """The images of a recording that no row which can be read names."""
    named = {frame.image.path for frame in frames if frame.image}
    named |= {file for f in frames if f.depth for file in (f.depth.path, f.depth.confidence) if file}
    images = in_order(p for p in path.rglob("*") if is_image(p))
    return unused(session_id, images, named, "image isn't named by a row that can be read", root=path)


def _header(path: Path, line: str) -> dict[str, Any]:
    try:
        header = parse_json(line)
    except BadRow:
        header = {}
    device, clock = header.get("device", "unknown"), header.get("clock", Clock.BOOT)
    first_row, readout_s = header.get("first_row"), header.get("readout_s")
    gravity_aligned = header.get("gravity_aligned")
    if (
        header.get("groundwalk") != "frames"
        or header.get("version") != _VERSION
        or not isinstance(device, str)
        or clock not in _CLOCKS
        or first_row not in [None, *ImageSide]
        or not (gravity_aligned is None or isinstance(gravity_aligned, bool))
        or not (readout_s is None or (type(readout_s) in (int, float) and 0 <= readout_s <= MAX_READOUT_S))
    ):
        raise UserError(
            "the first line of frames.jsonl isn't its header",
            where=path / "frames.jsonl",
            expected=f'{{"groundwalk": "frames", "version": {_VERSION}, "device": "...", "clock": "boot"}}, '
            f"clock one of {', '.join(_CLOCKS)}; if there is a first_row, one of {', '.join(ImageSide)}; if there is a "
            f"readout_s, seconds, 0 to {MAX_READOUT_S:g}; if there is gravity_aligned, true or false",
            found=line[:120] or "an empty file",
        )
    first_row = first_row and ImageSide(first_row)
    values: dict[str, Any] = {"device": device, "clock": Clock(clock), "first_row": first_row, "readout_s": readout_s}
    if gravity_aligned is not None:
        values |= {"is_gravity_aligned": gravity_aligned, "up_source": UpSource.STATED}
    return values


def _depth(path: Path, row: dict[str, Any]) -> DepthFile:
    confidence = row.get("depth_confidence")
    return DepthFile(inside(path, row["depth"]), None if confidence is None else inside(path, confidence))


def _intrinsics(row: dict[str, Any]) -> Intrinsics:
    distortion = row.get("distortion", [])
    if not isinstance(distortion, list):
        raise BadRow("distortion is no list")
    fx, fy, cx, cy = (number(row, key) for key in ("fx", "fy", "cx", "cy"))
    coefficients = tuple(to_number(k, "distortion") for k in distortion)
    return Intrinsics(fx, fy, cx, cy, *optional_size(row, "width", "height"), coefficients)


FORMAT = Format(
    id="frames_jsonl",
    label="frames.jsonl (our own)",
    meaning="images, VIO, depth",
    looks_for="frames.jsonl",
    detect=detect,
    read=read,
)
