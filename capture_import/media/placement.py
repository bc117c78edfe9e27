"""How a session's images and depth images come to where they are used."""

from dataclasses import dataclass
from pathlib import Path

from groundwalk.capture_import.capture import Limits


@dataclass(frozen=True)
class Placement:
    """How a session's files are placed.

    `root` is the capture folder, `work` the artefact's. `copies`: files of the capture are copied. Images are turned
    by `quarters` clockwise.
    """

    root: Path
    work: Path
    session_id: str
    copies: bool
    quarters: int
    limits: Limits

    def stays(self, file: Path) -> bool:
        """Whether a file is used where the capture has it."""
        return not self.copies and file.is_relative_to(self.root)

    def write(self, data: bytes, kind: str, number: int, suffix: str) -> str:
        """Write a frame's file into the artefact; returns its entry."""
        target = self.work / kind / self.session_id / f"{number:06d}{suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
        return f"import:{target.relative_to(self.work).as_posix()}"
