"""What a user types: commands, and where a setting goes."""

from groundwalk import CHECKOUT

ANY_SCENE = "<scene>"
"""Stands in advice for the scene's name, which a stage puts there as it says the advice."""


def run_command(scene: str, profile: str, stage: str) -> str:
    """What makes a scene up to a stage: a make target in a checkout, `groundwalk run` where there is no Makefile."""
    if CHECKOUT is not None:
        return f"make scene={scene} profile={profile} {'all' if stage == 'report' else stage}"
    return f"groundwalk run --scene {scene} --profile {profile} --until {stage}"


def view_command(scene: str, profile: str) -> str:
    """What opens a scene's recordings."""
    if CHECKOUT is not None:
        return f"make scene={scene} profile={profile} view"
    return f"groundwalk view --scene {scene} --profile {profile}"


def link_command(scene: str) -> str:
    """What runs a scene on captures of the user's own."""
    if CHECKOUT is not None:
        return f"make scene={scene} captures=<your folder> all"
    return f"groundwalk run --scene {scene} --captures <your folder>"


def setting_of(section: str, setting: str, scene: str = ANY_SCENE) -> str:
    """Where a user sets a setting, perhaps with its value, for a scene alone."""
    return f"[{section}] {setting} in data/scenes/{scene}.toml"
