"""Which files of a capture folder the simulator wrote, and what it made, by the marker that it left."""

from pathlib import Path
from typing import Any

from groundwalk.artefacts.choices import Appearance
from groundwalk.artefacts.errors import UserError
from groundwalk.artefacts.files import read_json

SIMULATED_MARKER = "SIMULATED.json"
TRUE_POSES = "true_poses.parquet"
TRUE_CAMERAS = "true_cameras.parquet"
TRUTH_FILES = (TRUE_POSES, TRUE_CAMERAS)
FRAME = "frame_{:05d}"


def appearance_of(captures: Path) -> Appearance:
    """What the test walks of a simulated capture folder see, beside its training walks; UserError where its marker says
    something unknown."""
    stated = read_json(captures / SIMULATED_MARKER).get("appearance", Appearance.SAME)
    if stated not in list(Appearance):
        expected = f"appearance one of {', '.join(Appearance)}"
        where = captures / SIMULATED_MARKER
        raise UserError("the marker of simulated captures is damaged", where=where, expected=expected, found=stated)
    return Appearance(stated)


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
