"""The command that makes an artefact, as the user would type it."""

from groundwalk import CHECKOUT


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
