"""What a user types: commands, which work as they are printed where they are printed, and where a setting goes."""

import shlex
import shutil
import sys
from pathlib import Path

from groundwalk.store.checkout import CHECKOUT
from groundwalk.store.settings import DataRoot

ANY_SCENE = "<scene>"
"""Stands in advice for the scene's name, which a stage puts there as it says the advice."""
_ANY_FILE = f"data/scenes/{ANY_SCENE}.toml"


def run_command(artefact: Path) -> str:
    """What makes a scene up to the stage whose artefact is the folder data/runs/<profile>/<scene>/<stage>."""
    if artefact.parts[-4:-3] != ("runs",):
        return f"run the stage {artefact.name} where this run comes from, and copy it again"
    profile, scene, stage = artefact.parts[-3:]
    goal = "all" if stage == "report" else stage
    return _command(artefact.parents[3], scene, profile, goal, "run", f" --until {stage}")


def view_command(run: Path) -> str:
    """What opens a scene's recordings, those of data/runs/<profile>/<scene>."""
    profile, scene = run.parts[-2:]
    return _command(run.parents[2], scene, profile, "view", "view")


def simulate_command(captures: Path, profile: str) -> str:
    """What simulates the captures data/captures/<scene> as a profile has them, in place of those that are there."""
    return _command(captures.parents[1], captures.name, profile, "simulate", "simulate")


def link_command(captures: Path, profile: str) -> str:
    """What runs a scene on captures of the user's own, which become the folder data/captures/<scene>."""
    goal, option = "captures=<your folder> all", " --captures <your folder>"
    return _command(captures.parents[1], captures.name, profile, goal, "run", option)


def _command(data: Path, scene: str, profile: str, goal: str, command: str, option: str = "") -> str:
    """One of make where the Makefile is at hand, and is about this data folder; elsewhere one of groundwalk."""
    if CHECKOUT is not None and Path.cwd() == CHECKOUT and data == CHECKOUT / "data":
        return f"make scene={scene} profile={profile} {goal}"
    elsewhere = "" if data == Path.cwd() / "data" else f" --data {shlex.quote(str(data))}"
    return f"{groundwalk_command()} {command} --scene {scene} --profile {profile}{option}{elsewhere}"


def setting_of(section: str, setting: str, file: str = _ANY_FILE) -> str:
    """Where a user sets a setting, perhaps with its value, for a scene alone: in the scene's file."""
    return f"[{section}] {setting} in {file}"


def scene_file(data: DataRoot, scene: str) -> str:
    """The user's file of a scene's settings, there or to be made."""
    file = data.root / "scenes" / f"{scene}.toml"
    return str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file)


def of_scene(advice: str, data: DataRoot, scene: str) -> str:
    """Advice that `setting_of` gave for any scene, for this one."""
    return advice.replace(_ANY_FILE, scene_file(data, scene)).replace(ANY_SCENE, scene)


def groundwalk_command() -> str:
    """The command `groundwalk`, with its folder where the shell wouldn't find it."""
    script = Path(sys.executable).with_name("groundwalk")
    if shutil.which("groundwalk"):
        return "groundwalk"
    return shlex.quote(str(script)) if script.exists() else f"{shlex.quote(sys.executable)} -P -m groundwalk"
