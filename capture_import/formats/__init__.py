"""One module a capture format. Each has ``FORMAT``: what it is called, how it's recognised, how it's read.

To add a format, write a module beside these and name it in `_MODULES`; CONTRIBUTING has the steps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawSession

_MODULES = (
    "scanner_app",
    "stray_scanner",
    "record3d",
    "polycam",
    "nerf_capture",
    "scan_capture",
    "ios_logger",
    "spectacular_ai",
    "frames_jsonl",
    "arkit_logger",
    "arcore_logger",
    "invisible_map",
    "arkit_scenes",
    "seven_scenes",
    "cambridge",
    "colmap",
    "nerfstudio",
)


@dataclass(frozen=True)
class Format:
    """A capture format.

    `detect` says, from names alone or the first bytes of a file, whether a folder or file is one recording in this
    format. `read` gets that folder or file, the session's id and the limits; it raises UserError where the recording
    as a whole can't be read.
    """

    name: str
    title: str
    gives: str
    looks_for: str
    documentation: str
    detect: Callable[[Path], bool]
    read: Callable[[Path, str, Limits], RawSession]


@cache
def formats() -> tuple[Format, ...]:
    """All formats, in the order in which they are listed."""
    return tuple(import_module(f"groundwalk.capture_import.formats.{module}").FORMAT for module in _MODULES)
