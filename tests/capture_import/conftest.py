"""Where captures lie that a test imports."""

from pathlib import Path

import pytest


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """The folder for captures of the scene `place`, whose data folder is `tmp_path`."""
    folder = tmp_path / "captures" / "place"
    folder.parent.mkdir()
    return folder
