"""Fixtures that every test package may use."""

from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, however slow the machine: a test run says something about the change, not about luck.
# `pytest --hypothesis-profile=search` draws new ones.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("search", deadline=None)
settings.load_profile("steady")

SHARED = Path(__file__).resolve().parents[2] / "shared"


def _shared(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"real recordings aren't here: no folder ../shared/{name} beside the repository")
    return folder


@pytest.fixture(scope="session")
def shared_captures() -> Path:
    """Real ARKit captures (chair, corridor); skips where they are absent."""
    return _shared("captures")


@pytest.fixture(scope="session")
def shared_trajectories() -> Path:
    """Real VIO recordings; skips where they are absent."""
    return _shared("trajectories")
