"""Where COLMAP works: a folder of links to the images, and checkpoints that a killed run goes on from."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from groundwalk.store.child import Task, in_child
from groundwalk.store.hints import setting_of

_MEMORY_HINT = f"too little memory needs a smaller max_features or {setting_of('sfm', 'max_image_size')}"


@dataclass(frozen=True)
class Workspace:
    """`images` holds a link to the image of each of N frames, by its name; `scratch` is for checkpoints."""

    images: Path
    names: Sequence[str]
    scratch: Path

    def in_child(self, text: str, task: Task) -> Any:
        """The result of a task in a child process: an error on one of COLMAP's threads aborts the one it runs in."""
        return in_child(text, self.scratch / "colmap.log", _MEMORY_HINT, task)
