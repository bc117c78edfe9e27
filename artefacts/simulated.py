"""Which files of a capture folder the simulator wrote, by the marker that it left."""

from typing import Any

SIMULATED_MARKER = "SIMULATED.json"
TRUE_POSES = "true_poses.parquet"
TRUE_CAMERAS = "true_cameras.parquet"
TRUTH_FILES = (TRUE_POSES, TRUE_CAMERAS)
FRAME = "frame_{:05d}"


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
