"""`python -m groundwalk.store`: look at, link and remove what the stages made."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from groundwalk.store import progress
from groundwalk.store.cleaning import clean_scene
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.locks import locked
from groundwalk.store.settings import DataRoot
from groundwalk.store.web_viewer import view_run

app = new_app("Look at, link and remove what the stages made.")


@app.command()
def view(
    scene: SceneOption,
    profile: ProfileOption = "demo",
    web: Annotated[bool, typer.Option("--web", help="In a browser, served to this machine only.")] = False,
    data: DataOption = Path("data"),
) -> None:
    """Open the recordings of all finished stages in the Rerun viewer; each has its own blueprint."""
    sys.exit(view_run(DataRoot(data).run(profile, scene), web=web))


def link_folder(data: DataRoot, scene: str, folder: Path) -> None:
    """Make data/captures/<scene> a link to a folder of captures, which stays as it is. UserError where there is no such
    folder, where the data folder is in it, for a group of scenes, and where the scene has captures already."""
    link, folder = data.captures(scene), folder.resolve()
    if not folder.is_dir():
        raise UserError("the captures folder isn't there", where=folder, expected="a folder of phone captures")
    root = data.root.resolve()
    if root.is_relative_to(folder) and not any(part.startswith(".") for part in root.relative_to(folder).parts):
        raise UserError(
            "results would be written into the captures, where the next run reads them as captures",
            where=folder,
            found=f"the data folder in it, {data.root}",
            do="give the command in another folder, or name one with --data (judge: --out)",
        )
    if data.scene(scene)[0].is_group:
        raise UserError(f"{scene} is a group of scenes, which has no captures of its own", do="name one of its scenes")
    if link.resolve() == folder:
        return
    with locked(link):
        if link.is_symlink():
            link.unlink()
        elif link.exists():
            raise UserError(
                f"scene {scene} has captures already",
                where=link,
                expected="nothing, or a link to other captures",
                do="name another scene, or move that folder away",
            )
        link.symlink_to(folder, target_is_directory=True)


@app.command()
def clean(scene: SceneOption, profile: ProfileOption = "demo", data: DataOption = Path("data")) -> None:
    """Remove a scene's artefacts of one profile, and its captures where they are simulated; never a real capture.

    Only files that a manifest, a run's key file or SIMULATED.json lists are removed. What else is there is named and
    left, and no link is followed.
    """
    cleaned = clean_scene(DataRoot(data), profile, scene)
    for path in cleaned.removed:
        progress.stdout.print(f"removed {path}")
    for path in cleaned.left:
        progress.stdout.print(f"left as it is, not made by groundwalk: {path}")


if __name__ == "__main__":
    app()
