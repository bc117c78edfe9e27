"""The contract between stages: settings, table schemas, atomic stage runs, recordings, errors and progress."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundwalk.store.definition import Stage
    from groundwalk.store.errors import UserError
    from groundwalk.store.settings import DataRoot, SceneConfig, Settings
    from groundwalk.store.stage import StageRun, execute

__all__ = ["DataRoot", "SceneConfig", "Settings", "Stage", "StageRun", "UserError", "execute"]

_MODULES = dict.fromkeys(("DataRoot", "SceneConfig", "Settings"), "settings")
_MODULES |= {"Stage": "definition", "StageRun": "stage", "UserError": "errors", "execute": "stage"}


def __getattr__(name: str) -> Any:
    """Each name is loaded when it's asked for: a child process needs few of them, and the viewer's library, which
    stages record with, takes a second to load."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
