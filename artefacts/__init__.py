"""The contract between stages: settings, table schemas, atomic stage runs, recordings, errors and progress."""

from artefacts.errors import UserError
from artefacts.settings import DataRoot, SceneConfig, Settings
from artefacts.stage import Stage, StageRun, execute

__all__ = ["DataRoot", "SceneConfig", "Settings", "Stage", "StageRun", "UserError", "execute"]
