"""Which files of a capture folder the simulator wrote, and what it made, by the marker that it left."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from groundwalk.artefacts.choices import Appearance
from groundwalk.artefacts.errors import UserError
from groundwalk.artefacts.files import read_json

SIMULATED_MARKER = "SIMULATED.json"
EXPORT_NOTE = "export.json"
TRUE_POSES = "true_poses.parquet"
TRUE_CAMERAS = "true_cameras.parquet"
TRUTH_FILES = (TRUE_POSES, TRUE_CAMERAS)
FRAME = "frame_{:05d}"


def are_simulated(files: Iterable[Path]) -> bool:
    """Whether a capture's files say that it is simulated, or an export of a simulated scene."""
    return any(
        file.name == SIMULATED_MARKER or (file.name == EXPORT_NOTE and read_json(file).get("simulated") is True)
        for file in files
    )


def appearances_of(captures: Path) -> dict[str, Appearance]:
    """What is seen on each session of a capture folder whose marker says it: none of a real one. UserError where the
    marker says something unknown."""
    where = captures / SIMULATED_MARKER
    sessions = read_json(where).get("sessions", {})
    try:
        return {name: Appearance(facts["appearance"]) for name, facts in sessions.items() if "appearance" in facts}
    except (AttributeError, TypeError, ValueError) as error:
        expected = f"appearance one of {', '.join(Appearance)}"
        raise UserError(
            "the marker of simulated captures is damaged", where=where, expected=expected, found=error
        ) from None


def simulated_files(marker: dict[str, Any]) -> set[str]:
    """The files that a simulated capture folder's marker stands for, relative to the folder.

    Raises ValueError where the marker doesn't say which sessions there are.
    """
    files = {SIMULATED_MARKER, *TRUTH_FILES}
    try:
        for name, count in marker["sessions"].items():
            files |= {f"{name}/info.json"} | {f"{name}/{FRAME.format(i)}.json" for i in range(count["poses"])}
            every = count["poses"] // count["images"]
            files |= {f"{name}/{FRAME.format(i)}.jpg" for i in range(0, count["poses"], every)}
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ValueError(f"{SIMULATED_MARKER} doesn't list its sessions: {error!r}") from None
    return files
