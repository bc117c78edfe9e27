"""Made-up scenes, as a fixture, and reports without what takes most of their time."""

import pytest

from groundwalk.reports import stage
from tests.reports.made_up_scenes import make_run  # noqa: F401


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    parts: dict[str, list[object]] = {part: [] for part in ("drift", "training", "errors")}
    monkeypatch.setattr(stage, "scene_figures", lambda scene, folder: parts)
