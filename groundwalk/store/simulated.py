"""Which files of a capture folder the simulator wrote, and what it made, by the marker that it left."""

import re
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
_FRAME_FILE = re.compile(r"frame_([0-9]{5,20})\.(json|jpg)")
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
    """The files of a simulated capture folder, relative to it, that its marker stands for; none where the marker
    doesn't say which sessions there are."""
    try:
        counts = {
            name: (int(count["poses"]), max(count["poses"] // count["images"], 1))
            for name, count in marker_of(captures)["sessions"].items()
        }
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return set()

    def is_listed(file: str) -> bool:
        session, _, name = file.rpartition("/")
        if session not in counts:
            return file in (SIMULATED_MARKER, *TRUTH_FILES)
        frame = _FRAME_FILE.fullmatch(name)
        if frame is None:
            return name == "info.json"
        index, (poses, every) = int(frame[1]), counts[session]
        is_numbered = index < poses and name.startswith(f"{FRAME.format(index)}.")
        return is_numbered and (frame[2] == "json" or index % every == 0)

    return {*filter(is_listed, file_names(captures))}
