"""Regressors for the fusion benchmark's *trained* walks: `make bench-trained`.

Simulated demos that are longer than the profile's, with six training walks a scene: enough for 60 held-out frames, from
which a map of errors is learnt, and for test walkers to be seen from where someone has walked before. Each scene goes
from simulation to training through the stages, as a user would run them; what is up to date isn't run again.
"""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.groundtruth_inputs import run_stage, simulated
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import new_app

FOLDER = Path("build/trained")
# Settings of simulation and of training. In a room, telling a step aside from a turn takes more epochs.
SCENES = {
    "Church": (["frame_fraction=0.5", "train_sessions=6"], []),
    "Office": (["frame_fraction=0.42", "train_sessions=6"], ["regressors.PN.epochs=140", "regressors.MS-T.epochs=160"]),
}

app = new_app(__doc__ or "")


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="Data folder to fill.")] = FOLDER,
    scenes: Annotated[str, typer.Option(help="Scenes, joined by commas.")] = ",".join(SCENES),
) -> None:
    """Simulate, import, map, align and train; an hour and a half on two cores."""
    root = DataRoot(data)
    if unknown := set(scenes.split(",")) - set(SCENES):
        raise UserError(f"unknown: {', '.join(sorted(unknown))}", expected=", ".join(SCENES))
    for scene in scenes.split(","):
        walks, training = SCENES[scene]
        simulated(scene, root, *walks)
        for stage, settings in (("sfm", []), ("alignment", []), ("training", training)):
            run_stage(stage, scene, root, *settings)


if __name__ == "__main__":
    app()
