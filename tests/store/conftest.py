"""Fixtures of the store's tests."""

from pathlib import Path

import pytest

from groundwalk.store import DataRoot
from tests.store.places import place


@pytest.fixture
def data(tmp_path: Path) -> DataRoot:
    """A data folder with one capture, of scene `place`."""
    return place(tmp_path / "data")
