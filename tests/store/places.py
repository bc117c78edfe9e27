"""A data folder with one capture, and stages that stand in for real ones."""

from collections.abc import Callable
from pathlib import Path

from groundwalk.store import DataRoot, Settings, Stage, StageRun
from tests.known import written


class NoSettings(Settings):
    pass


Run = Callable[[StageRun[NoSettings]], None]


def stage(run: Run, name: str = "import") -> Stage[NoSettings]:
    """A stage that reads the captures."""
    return Stage(name, 1, NoSettings, (), run, "", reads_captures=True)


def place(root: Path) -> DataRoot:
    """A data folder with a capture of scene `place`, and a profile `own` that sets nothing."""
    written(root / "captures" / "place" / "walk" / "frame.json", "{}")
    written(root / "profiles" / "own.toml", "")
    return DataRoot(root)
