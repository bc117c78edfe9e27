"""A small place to localise in, as a fixture."""

import pytest
import torch

from tests.picture_wall import make_scene  # noqa: F401


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)
