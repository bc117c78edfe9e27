"""Which files of a capture folder the simulator wrote, and what it made, by the marker that it left."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from groundwalk.store.files import file_names, read_json

SIMULATED_MARKER = "SIMULATED.json"
EXPORT_NOTE = "export.json"
TRUE_POSES = "true_poses.parquet"
TRUE_CAMERAS = "true_cameras.parquet"
TRUTH_FILES = (TRUE_POSES, TRUE_CAMERAS)
FRAME = "frame_{:05d}"
_MAX_DIGITS = 20
_MAX_MARKER_BYTES = 4 << 20


def are_simulated(files: Iterable[Path]) -> bool:
    """Whether a capture's files say that it is simulated, or an export of a simulated scene."""
    return any(
        file.name == SIMULATED_MARKER or (file.name == EXPORT_NOTE and read_json(file).get("simulated") is True)
        for file in files
    )


def marker_of(captures: Path) -> dict[str, Any]:
    """What the simulator left in a capture folder; {} in one that it didn't write."""
    return read_json(captures / SIMULATED_MARKER, _MAX_MARKER_BYTES)


def simulated_files(captures: Path) -> set[str]:
    """The files of a simulated capture folder, relative to it, that its marker stands for.

    Raises ValueError where the marker doesn't say which sessions there are.
    """
    try:
        counts = {
            name: (int(count["poses"]), count["poses"] // count["images"])
            for name, count in marker_of(captures)["sessions"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
        raise ValueError(f"{SIMULATED_MARKER} doesn't list its sessions: {error!r}") from None

    def is_listed(file: str) -> bool:
        session, _, name = file.rpartition("/")
        if session not in counts:
            return file in (SIMULATED_MARKER, *TRUTH_FILES)
        poses, every = counts[session]
        stem, _, suffix = name.rpartition(".")
        digits = stem.removeprefix("frame_")
        index = int(digits) if digits.isdecimal() and len(digits) < _MAX_DIGITS else poses
        is_frame = index < poses and stem == FRAME.format(index)
        has_image = is_frame and index % max(every, 1) == 0
        return name == "info.json" or (is_frame and suffix == "json") or (has_image and suffix == "jpg")

    return {*filter(is_listed, file_names(captures))}
