"""Our own format: `frames.jsonl`, a header and then one JSON object an instant, with images beside it, as
docs/reference/capture-formats.md describes it."""

from dataclasses import replace
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import DepthFile, GpsFix, ImageFile, Intrinsics, Limits, RawFrame, Recording
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.shutter import MAX_READOUT_S
from groundwalk.store import UserError
from groundwalk.store.choices import Clock, ImageSide, Tracking, UpSource

_VERSION = 1
_CLOCKS = [clock for clock in Clock if clock.has_times]


def read(path: Path, limits: Limits) -> Recording:
    lines = parsing.lines_of(path / "frames.jsonl", limits)
    header = _header(path, lines[0][1] if lines else "")

    def read_row(_: int, line: str) -> RawFrame:
        row = parsing.parse_json(line)
        t_ns = row.get("t_ns")
        if not isinstance(t_ns, int) or abs(t_ns) > parsing.MAX_NS:
            raise parsing.BadRow("t_ns is no whole number of nanoseconds")
        tracking = row.get("tracking", Tracking.UNKNOWN)
        if tracking not in [*Tracking]:
            raise parsing.BadRow(f"tracking is none of {', '.join(Tracking)}")
        pose = None
        if row.get("vio_T_cam") is not None:
            pose = parsing.row_major_pose(parsing.numbers(row, "vio_T_cam", 16))
        image, depth, confidence = (
            parsing.inside(path, row[key]) if row.get(key) is not None else None
            for key in ("image", "depth", "depth_confidence")
        )
        return RawFrame(
            t_ns,
            pose,
            ImageFile(image) if image else None,
            _intrinsics(row) if image else None,
            Tracking(tracking),
            parsing.optional_number(row, "exposure_s"),
            DepthFile(depth, confidence) if depth else None,
        )

    frames, rejects = parsing.read_rows(lines[1:], read_row)
    read_gps = partial(parsing.read_fixes, lines[1:], _read_fix)
    return Recording(folder=path, frames=frames, rejects=rejects, read_gps=read_gps, **header)


def _read_fix(_: int, line: str) -> GpsFix | None:
    row = parsing.parse_json(line)
    if row.get("latitude_deg") is None:
        return None
    latitude, longitude = (parsing.number(row, key) for key in ("latitude_deg", "longitude_deg"))
    stated = (parsing.optional_number(row, key) for key in ("altitude_m", "accuracy_m", "altitude_sd_m"))
    altitude, accuracy, altitude_sd = (nan if value is None else value for value in stated)
    return GpsFix(parsing.whole(row, "t_ns"), latitude, longitude, altitude, accuracy, altitude_sd)


def _header(path: Path, line: str) -> dict[str, Any]:
    try:
        header = parsing.parse_json(line)
    except parsing.BadRow:
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


def _intrinsics(row: dict[str, Any]) -> Intrinsics:
    distortion = row.get("distortion", [])
    if not isinstance(distortion, list):
        raise parsing.BadRow("distortion is no list")
    coefficients = tuple(parsing.to_number(k, "distortion") for k in distortion)
    return replace(parsing.intrinsics(row), distortion=coefficients)


FORMAT = Format(
    id="frames_jsonl", label="frames.jsonl (our own)", meaning="images, VIO, depth", files=("frames.jsonl",), read=read
)
