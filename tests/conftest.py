"""Fixtures that every test package may use."""

import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from pathlib import Path

import pytest
from hypothesis import settings

from tests.picture_wall import trained_wall, wall_bundle  # noqa: F401

# The same examples in every run, however slow the machine: a test run says something about the change, not about luck.
# `pytest --hypothesis-profile=search` draws new ones.
settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("search", deadline=None)
settings.load_profile("steady")

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared"
# Commands that tests start, in whatever folder, run this tree, which need not be the one that is installed.
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])


class OneName(MetaPathFinder):
    """Refuses `sfm` for `groundwalk.sfm`: with the root on the path, both would load, as two modules."""

    packages = frozenset(path.name for path in (ROOT / "groundwalk").iterdir() if path.is_symlink())

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: object = None) -> None:
        if fullname.split(".")[0] in self.packages:
            raise ImportError(f"{fullname} is imported as groundwalk.{fullname}, its one name")


sys.meta_path.insert(0, OneName())


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
