"""The test walks of a simulated capture in the simulator's other lights, pose by pose: `python -m benchmarks.lights`.

Only images are made, with the capture's settings and seed: the walks are the same in every light, so that the ground
truth of the capture's frames is theirs, too. `--picture` puts one frame in all lights into a file.
"""

import os
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.simulate import plan_sessions, render_images, write_truth
from groundwalk.store import DataRoot, UserError
from groundwalk.store.choices import Appearance
from groundwalk.store.cli import new_app
from groundwalk.store.files import read_json, written_aside
from groundwalk.store.schemas import schema
from groundwalk.store.simulated import SIMULATED_MARKER, TRUE_POSES, appearances_of
from groundwalk.store.tables import poses_of, read_table

app = new_app(__doc__ or "")

OTHERS = tuple(appearance for appearance in Appearance if appearance != Appearance.SAME)
_COLUMNS, _WIDTH, _GAP = 4, 360, 6


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="The data folder with the simulated capture.")] = Path("data"),
    scene: Annotated[str, typer.Option(help="The simulated scene.")] = "Church",
    out: Annotated[Path, typer.Option(help="Folder for the images.")] = Path("build/lights"),
    light: Annotated[list[Appearance] | None, typer.Option(help="The lights; all but same unless given.")] = None,
    processes: Annotated[int, typer.Option(help="Processes that render.", min=1)] = os.cpu_count() or 1,
    picture: Annotated[Path | None, typer.Option(help="A file for frames in all lights, a JPEG.")] = None,
    frames: Annotated[int, typer.Option(help="Frames in the picture.", min=1)] = 2,
) -> None:
    """Render the test walks of a simulated capture in other lights."""
    captures = DataRoot(data).captures(scene)
    for appearance in light or OTHERS:
        frames_in(captures, appearance, out / scene / appearance, processes)
    if picture:
        draw(captures, out / scene, picture, frames)


def frames_in(captures: Path, appearance: Appearance, out: Path, processes: int) -> None:
    """Images of a simulated capture's test walks in a light, in folders of `out` named by session; those that are there
    are kept. UserError where the capture isn't simulated, or was simulated by another version."""
    marker = _marker(captures)
    settings = SimulateSettings.model_validate({**marker["settings"], "appearances": [appearance]})
    indoor, seed = marker["environment"] == "indoor", marker["seed"]
    out.mkdir(parents=True, exist_ok=True)
    sessions = plan_sessions(marker["scene"], settings, indoor, out, seed, test_only=True)
    write_truth(out, sessions)
    here, there = (read_table(folder / TRUE_POSES, schema("simulate", "true_poses")) for folder in (out, captures))
    there = there[there["session_id"].isin(here["session_id"])].reset_index(drop=True)
    same = here[["session_id", "t_ns"]].equals(there[["session_id", "t_ns"]])
    if not (same and np.array_equal(poses_of(here, "map_cam"), poses_of(there, "map_cam"))):
        raise UserError("the capture's test walks aren't those of this simulator", where=captures, do="simulate again")
    render_images([shot for session in sessions for shot in session.shots], settings, out, processes)


def _marker(captures: Path) -> dict[str, Any]:
    marker = read_json(captures / SIMULATED_MARKER)
    if set(appearances_of(captures).values()) != {Appearance.SAME}:
        raise UserError(
            "this isn't a simulated capture whose test walks have the training walks' light",
            where=captures / SIMULATED_MARKER,
            do="simulate the scene with appearances same alone",
        )
    return marker


def draw(captures: Path, lights: Path, picture: Path, count: int) -> None:
    """A row of every light for each of `count` frames, spread over the first test walk."""
    names = sorted(path.name for path in (captures / "test-1").glob("*.jpg"))
    rows = []
    for number in range(count):
        name = names[len(names) * (2 * number + 1) // (2 * count)]
        files = [captures / "test-1" / name, *(lights / light / "test-1" / name for light in OTHERS)]
        images = [np.asarray(cv2.imread(str(file))) for file in files]
        small = [
            cv2.resize(i, (_WIDTH, _WIDTH * i.shape[0] // i.shape[1]), interpolation=cv2.INTER_AREA) for i in images
        ]
        gap = np.full((small[0].shape[0], _GAP, 3), 255, np.uint8)
        rows.append(np.hstack([part for image in small for part in (gap, image)][1:]))
    gap = np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8)
    _, data = cv2.imencode(
        ".jpg", np.vstack([p for row in rows for p in (gap, row)][1:]), [cv2.IMWRITE_JPEG_QUALITY, 82]
    )
    with written_aside(picture) as partial:
        partial.write_bytes(data.tobytes())


if __name__ == "__main__":
    app()
