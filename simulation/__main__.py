"""`python -m groundwalk.simulation --scene …`: simulated captures for a scene that has none."""

import os
from pathlib import Path
from typing import Annotated

import typer

from groundwalk.simulation.scenes import NAMES
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.simulate import simulate
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, SeedOption, SetOption, new_app, settings_help
from groundwalk.store.settings import DataRoot

_HELP = (
    f"Simulate captures of {', '.join(NAMES)} into data/captures: procedural places, hand-held walks, rendered images, "
    "poses with the drift of a phone. Captures that are there and weren't written by it are never touched."
)
app = new_app("")


@app.command(help=_HELP, epilog=settings_help("simulate", SimulateSettings))
def main(
    scene: SceneOption,
    profile: ProfileOption = "demo",
    set_: SetOption = None,
    seed: SeedOption = 0,
    force: Annotated[bool, typer.Option("--force", help="Simulate anew, even if it's up to date.")] = False,
    processes: Annotated[
        int, typer.Option(help="Processes that render.", min=1, show_default="one a core")
    ] = os.cpu_count() or 1,
    data: DataOption = Path("data"),
) -> None:
    """Simulate one scene, or each scene of a group."""
    root = DataRoot(data)
    for leaf in root.leaves(root.scene(scene)[0]):
        simulate(leaf, profile, root, set_, seed, force, processes)


if __name__ == "__main__":
    app()
