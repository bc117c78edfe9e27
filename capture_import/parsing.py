"""Typed reading of unchecked logs: lines, JSON, numbers, poses and paths, with one exception for what is wrong."""

import functools
import json
import math
import re
import stat
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from groundwalk.capture_import.capture import Accelerations, GpsFix, Intrinsics, Limits, RawFrame, Reject
from groundwalk.geometry import GeometryError
from groundwalk.geometry.lens import rational_of_fisheye
from groundwalk.geometry.poses import Array, pose_from_tq
from groundwalk.store import UserError
from groundwalk.store.files import leads_outside
from groundwalk.store.text import encoding_of, natural_order

Row = TypeVar("Row")

# A world with +z up, seen with +y up.
YUP_T_ZUP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
# An iPhone's image is upright when the home button is on the right; its screen's x is to the right, y up.
_CAM_R_PHONE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MAX_NS = 2**62  # so that times can be subtracted
_CAMERA, _SIZE = ("fx", "fy", "cx", "cy"), ("width", "height")
_MAX_LINE = 1 << 20
_MAX_SMALL_FILE = 1 << 20
_FISHEYE_TOLERANCE_PX = 0.05
_NOT_UTF8 = "\N{REPLACEMENT CHARACTER}"  # stands for bytes that aren't: they cost what they are in, not the whole log
# Clocks that were written with microseconds agree to this.
_SAME_NS = 1_000_000
# HEIC is read where its decoder is installed; else such an image is a reject, which says what to do.
SUFFIXES = (".jpg", ".jpeg", ".png", ".heic", ".heif")


class BadRow(ValueError):
    """A row or file of a log that can't be read; the message says why, short enough for a rejects table."""


@contextmanager
def refused(what: str, where: Path, expected: str | None = None) -> Iterator[None]:
    """UserError where what is done meanwhile raises BadRow, or finds too few numbers."""
    try:
        yield
    except ValueError as error:
        raise UserError(what, where=where, expected=expected, found=error) from None


def read_rows(
    rows: Iterable[tuple[str, Row]], read: Callable[[int, Row], RawFrame]
) -> tuple[list[RawFrame], list[Reject]]:
    """The frame of each row, named by its source, by `read(place, row)`; where `read` gives no number, its place among
    the rows is the frame's. A row that raises BadRow, or isn't UTF-8, becomes a reject."""
    frames, rejects = [], []
    for place, (source, row) in enumerate(rows):
        try:
            if isinstance(row, str) and _NOT_UTF8 in row:
                raise BadRow("row isn't UTF-8 text")
            frame = read(place, row)
        except BadRow as error:
            rejects.append(Reject(source, None, str(error)))
        else:
            frames.append(replace(frame, number=place if frame.number < 0 else frame.number, source=source))
    return frames, rejects


def without_images(frames: Sequence[RawFrame]) -> list[str]:
    """A note on the rows whose images aren't there, of a format in which each row has one; none where all are."""
    lost = [frame.source for frame in frames if frame.image is None]
    return [f"{len(lost)} of {len(frames)} poses have no image, such as {lost[0]}"] if lost else []


def read_fixes(
    rows: Iterable[tuple[str, Row]], read: Callable[[int, Row], GpsFix | None]
) -> tuple[list[GpsFix], list[Reject]]:
    """The position of each row that has one, by `read(place, row)`; a row that raises BadRow becomes a reject, as one
    that can't be a position on earth."""
    fixes, rejects = [], []
    for place, (source, row) in enumerate(rows):
        try:
            if (fix := read(place, row)) is None:
                continue
            latitude, longitude = fix.latitude_deg, fix.longitude_deg
            if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
                raise BadRow("GPS: latitude and longitude aren't a place on earth")
            # Phones state what they don't know as 0 or below.
            if not math.isnan(fix.accuracy_m) and not 0 < fix.accuracy_m < math.inf:
                raise BadRow(f"GPS: an accuracy of {fix.accuracy_m:g} m says that there is no position")
            is_known = math.isfinite(fix.altitude_m) and not fix.altitude_sd_m <= 0
            fixes.append(fix if is_known else replace(fix, altitude_m=math.nan, altitude_sd_m=math.nan))
        except BadRow as error:
            rejects.append(Reject(source, None, str(error)))
    return fixes, rejects


def core_motion(path: Path, limits: Limits, unit_s: float = 1.0) -> Accelerations | None:
    """What can be read of a log whose rows begin with time, in units of `unit_s`, and an acceleration as Core Motion
    has it: along the phone's axes; at rest it points down. None where there is no such file; a row more or less
    says nothing."""
    if not path.is_file():
        return None
    rows = []
    for _, line in lines_of(path, limits):
        with suppress(BadRow):
            time, *acceleration = split_numbers(line, separator=",")[:4]
            rows.append((seconds_to_ns(time * unit_s), *acceleration))
    table = np.array([row for row in rows if len(row) == 4], float).reshape(-1, 4)
    return Accelerations(table[:, 0].astype(np.int64), -table[:, 1:] @ _CAM_R_PHONE.T)


def nearest(rows: Sequence[RawFrame], t_ns: int, within_ns: int) -> int | None:
    """The place of the row, of rows in the order of time, that is nearest to a time; None where none is within."""
    at = bisect_left(rows, t_ns, key=lambda row: row.t_ns)
    around = {i: abs(rows[i].t_ns - t_ns) for i in (at - 1, at) if 0 <= i < len(rows)}
    near = min(around, key=around.__getitem__, default=-1)
    return near if around and around[near] <= within_ns else None


def join_by_time(poses: Sequence[RawFrame], images: Sequence[RawFrame]) -> list[RawFrame]:
    """One log from rows with poses and rows with images, in the order of time, numbered anew.

    An image within a millisecond of a pose becomes one row with it; other images stay without a pose, which is then
    interpolated.
    """
    poses = sorted(poses, key=lambda row: row.t_ns)
    joined: set[int] = set()
    rows = []
    for image in images:
        near = nearest(poses, image.t_ns, _SAME_NS)
        if near is not None and near not in joined:
            joined.add(near)
            image = replace(image, vio_T_cam=poses[near].vio_T_cam, tracking=poses[near].tracking)
        rows.append(image)
    rows += [row for i, row in enumerate(poses) if i not in joined]
    return [replace(row, number=i) for i, row in enumerate(sorted(rows, key=lambda row: row.t_ns))]


def read_text(path: Path, max_bytes: int = _MAX_SMALL_FILE) -> str:
    """A text file in UTF-8 or UTF-16; BadRow where it's missing, unreadable or larger than the limit."""
    try:
        _refuse_odd_file(path, max_bytes)
        return path.read_text(encoding=_encoding(path), errors="replace")
    except OSError as error:
        raise BadRow(f"{path.name} can't be read: {error.strerror}") from None


def _encoding(path: Path) -> str:
    with path.open("rb") as file:
        return encoding_of(file.read(2))


def first_bytes(path: Path, count: int = 1 << 16) -> bytes:
    """The beginning of a file, text as UTF-8; nothing where it's no ordinary file or can't be read."""
    start = b""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                start = file.read(count)
    return start.decode("utf-16", "ignore").encode() if encoding_of(start) == "utf-16" else start


def lines_of(path: Path, limits: Limits, is_row: Callable[[str], bool] = lambda line: True) -> list[tuple[str, str]]:
    """(source, line) of the lines of a text file that are rows: neither empty nor comments, and `is_row`; UserError as
    `numbered_lines`, or where they are more than the limits."""
    rows: list[tuple[str, str]] = []
    size = 0
    for number, line in numbered_lines(path, limits):
        if not line.strip() or line.startswith("#") or not is_row(line):
            continue
        rows.append((f"{path.name} line {number}", line))
        size += sys.getsizeof(line)
        if len(rows) > limits.max_rows or size > limits.max_parsed_bytes:
            found = f"more than {limits.max_rows} rows, or {limits.max_parsed_bytes >> 20} MiB of them"
            raise UserError("a log can't be read", where=path, found=found)
    return rows


def numbered_lines(path: Path, limits: Limits) -> Iterator[tuple[int, str]]:
    """All lines of a text file, numbered from 1, one in memory at a time. UserError where it can't be read, or where
    the file or a line is larger than the limits."""
    with refused("a log can't be read", path):
        try:
            _refuse_odd_file(path, limits.max_text_bytes)
            with path.open(encoding=_encoding(path), errors="replace") as file:
                for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE + 1), ""), start=1):
                    if len(line) > _MAX_LINE:
                        raise BadRow(f"line {number} is longer than {_MAX_LINE} characters")
                    yield number, line.removesuffix("\n")
        except OSError as error:
            raise BadRow(f"file can't be read: {error.strerror}") from None


def json_of(path: Path, limits: Limits) -> dict[str, Any]:
    """A recording's JSON file as an object; UserError where it can't be read, or would take more memory parsed than
    the limit."""
    with refused("a log can't be read", path):
        text = read_text(path, min(limits.max_text_bytes, limits.max_parsed_bytes // 4))
        if (needed := parsed_bytes(text)) > limits.max_parsed_bytes:
            raise BadRow(
                f"JSON of {len(text) >> 20} MiB would take about {needed >> 20} MiB of memory, more than the limit of "
                f"{limits.max_parsed_bytes >> 20} MiB"
            )
        return parse_json(text)


def parsed_bytes(text: str) -> int:
    """About how many bytes of memory a JSON text takes when it's parsed, the text itself included: CPython's sizes of
    lists, dictionaries, strings and numbers, by the characters that begin or part them."""
    sizes = {"[": 72, "{": 240, ",": 40, '"': 32}
    return sys.getsizeof(text) + len(text) + sum(size * text.count(character) for character, size in sizes.items())


def parse_json(text: str) -> dict[str, Any]:
    """A JSON object; BadRow where the text isn't one."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        if not text.strip():
            raise BadRow("file is empty") from None
        reason = str(error).split("\n")[0][:80] or "nested too deep"
        raise BadRow(f"file isn't {'UTF-8 text' if _NOT_UTF8 in text else f'JSON: {reason}'}") from None
    if not isinstance(content, dict):
        raise BadRow("JSON holds no object")
    return content


def number(row: Any, key: str) -> float:
    """The number under a key of an object (it may be NaN or infinite); BadRow where it's missing or no number."""
    return to_number(_get(row, key), key)


def whole(row: Any, key: str) -> int:
    """The whole number under a key; BadRow where it's missing or none."""
    value = number(row, key)
    if not math.isfinite(value) or value != int(value):
        raise BadRow(f"{key} {value} is no whole number")
    return int(value)


def optional_size(row: dict[str, Any], keys: Sequence[str]) -> tuple[int | None, int | None]:
    """The whole numbers under two keys, None where a log has neither: the image's own size holds then."""
    width, height = keys
    return (whole(row, width), whole(row, height)) if width in row or height in row else (None, None)


def intrinsics(row: Any, keys: Sequence[str] = _CAMERA, size: Sequence[str] = _SIZE) -> Intrinsics:
    """The pinhole under the keys of its focal lengths and principal point, and of its size if that is stated."""
    fx, fy, cx, cy = (number(row, key) for key in keys)
    return Intrinsics(fx, fy, cx, cy, *optional_size(row, size))


def optional_number(row: dict[str, Any], key: str) -> float | None:
    """The finite number under a key, or None where there is none."""
    try:
        value = number(row, key)
    except BadRow:
        return None
    return value if math.isfinite(value) else None


def numbers(row: Any, key: str, count: int) -> Array:
    """The list of `count` numbers under a key, as `to_numbers`."""
    return to_numbers(_get(row, key), key, count)


def to_numbers(value: Any, name: str, count: int) -> Array:
    """A list of `count` numbers, nested lists flattened in row order; BadRow otherwise."""
    if not isinstance(value, list):
        raise BadRow(f"{name} is no list")
    if value and all(isinstance(inner, list) for inner in value):
        value = [x for inner in value for x in inner]
    if len(value) != count:
        raise BadRow(f"{name} has {len(value)} numbers, not {count}")
    return np.array([to_number(v, name) for v in value])


def split_numbers(line: str, count: int | None = None, separator: str | None = None) -> list[float]:
    """The numbers of a line of text; BadRow where one isn't a number, or there aren't `count`."""
    values = [to_number(part.strip(), "value") for part in line.split(separator)]
    if count is not None and len(values) != count:
        raise BadRow(f"row has {len(values)} numbers, not {count}")
    return values


def yaml_numbers(text: str, key: str, count: int | None = None) -> list[float]:
    """The numbers under a key of a text in YAML, whose list may lie in `data` below it, as in OpenCV's dialect that no
    reader of YAML knows; BadRow where there are none, or not `count`."""
    found = re.search(rf"^{key}:\s*(?:(?:[^][\d\s][^][]*)?\[([^]]*)]|(\S+))", text, re.M)
    if found is None:
        raise BadRow(f"{key} is missing")
    return split_numbers(found[1] if found[2] is None else found[2], count, separator=",")


def to_number(value: Any, name: str) -> float:
    """`value`, a number or its text, as a float; BadRow otherwise."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise BadRow(f"{name} is no number")
    try:
        return float(value)
    except (ValueError, OverflowError):
        comma = isinstance(value, str) and re.fullmatch(r"[-+]?\d+,\d+(e[-+]?\d+)?", value, re.IGNORECASE)
        raise BadRow(f"{name} is no number{': it has a comma for a decimal point' if comma else ''}") from None


def to_pixels(value: float) -> int:
    """An image's width or height; BadRow where the number can't be one."""
    if not 0 < value < 1e6:
        raise BadRow(f"image size {value} is none")
    return int(value)


def seconds_to_ns(seconds: float, name: str = "time") -> int:
    """Seconds as int64 nanoseconds; BadRow where they aren't finite or don't fit."""
    ns = seconds * 1e9
    if not math.isfinite(ns) or abs(ns) > MAX_NS:
        raise BadRow(f"{name} {seconds} is no time")
    return round(ns)


def inside(folder: Path, name: Any) -> Path:
    """The path that a log names, relative to its folder; BadRow for one that is no text or leads out of the folder."""
    if not isinstance(name, str) or not name or "\0" in name:
        raise BadRow("image name is no text")
    try:
        name.encode()
    except UnicodeEncodeError:
        raise BadRow("image name has half of a character (a lone surrogate)") from None
    if leads_outside(name):
        raise BadRow("image name leads out of the recording")
    return folder / name


def row_major_pose(values: Sequence[float] | Array) -> Array:
    """A 4x4 pose from 12 or 16 numbers in row order."""
    pose = np.eye(4)
    flat = np.asarray(values, dtype=float)
    pose[: len(flat) // 4] = flat.reshape(-1, 4)
    return pose


def from_arkit(world_T_arkit_cam: Array) -> Array:
    """The same pose (4, 4) for OpenCV's camera axes, from ARKit's (x right, y up, z backward)."""
    # Signs alone: a matrix product would warn about the numbers that a broken log holds.
    return world_T_arkit_cam * np.array([1.0, -1.0, -1.0, 1.0])


def quaternion_pose(translation: Sequence[float], xyzw: Sequence[float]) -> Array:
    """A 4x4 pose from a position and a quaternion; BadRow where the quaternion is none."""
    with np.errstate(over="ignore", invalid="ignore"):
        norm = float(np.linalg.norm(xyzw))
    if not math.isfinite(norm) or abs(norm - 1) > 0.01:
        raise BadRow(f"quaternion has length {norm:.3g}, not 1")
    try:
        return pose_from_tq(translation, xyzw)
    except GeometryError as error:
        raise BadRow(str(error)) from None


@functools.lru_cache(maxsize=256)  # the fit takes milliseconds, and the frames of a capture mostly share a camera
def fisheye_intrinsics(
    fx_fy_cx_cy: tuple[float, ...], width: int, height: int, fisheye: tuple[float, ...]
) -> Intrinsics:
    """Intrinsics whose distortion (OpenCV's coefficients) is that of a fisheye lens with k1 to k4, within the image;
    BadRow where no such coefficients describe it."""
    fx, fy, cx, cy = fx_fy_cx_cy
    if not np.isfinite([*fx_fy_cx_cy, *fisheye]).all() or min(fx, fy) <= 0:
        raise BadRow("intrinsics have a value that isn't finite, or a focal length that isn't positive")
    radius = math.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    try:
        distortion = rational_of_fisheye(fisheye, radius, _FISHEYE_TOLERANCE_PX / max(fx, fy))
    except GeometryError as error:
        raise BadRow(str(error)) from None
    return Intrinsics(fx, fy, cx, cy, width, height, tuple(distortion.tolist()))


def _get(row: Any, key: str) -> Any:
    if not isinstance(row, dict):
        raise BadRow("row is no object")
    if key not in row:
        raise BadRow(f"{key} is missing")
    return row[key]


def _refuse_odd_file(path: Path, max_bytes: int) -> None:
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise BadRow("no ordinary file")
    if status.st_size > max_bytes:
        raise BadRow(f"file has {status.st_size} bytes, more than the limit of {max_bytes}")


def is_image(path: Path) -> bool:
    """Whether a name is an image's; hidden files aren't, as `._IMG_1.jpg`, in which macOS keeps attributes."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def images_in(folder: Path) -> list[Path]:
    """The image files of a folder, in natural order of their names; none where it isn't there."""
    return in_order(path for path in folder.iterdir() if is_image(path)) if folder.is_dir() else []


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Paths in natural order: frame2 before frame10."""
    return sorted(paths, key=lambda path: natural_order(path.as_posix()))


def by_stem(images: Iterable[Path]) -> dict[str, Path]:
    """Image files by their name without suffix; of two the one whose suffix is lower-case and first in `SUFFIXES`."""

    def rank(path: Path) -> tuple[bool, int]:
        return path.suffix.islower(), -SUFFIXES.index(path.suffix.lower())

    return {path.stem: path for path in sorted(images, key=rank)}
