"""Fixtures of the tests of groundwalk's own modules."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import make_pose
from groundwalk.store import DataRoot
from tests.groundwalk.made_up_run import FRAMES, MadeUpRun


@pytest.fixture
def make_run(tmp_path: Path) -> Callable[..., MadeUpRun]:
    """Makes a run whose named stages (all unless named) are finished."""

    def make(*stages: str) -> MadeUpRun:
        rng = np.random.default_rng(3)
        turns = Rotation.random(FRAMES, rng).as_matrix()
        along_a_line = np.outer(np.arange(FRAMES), [1.0, 0.0, 0.5])
        map_S_sfm = Sim3(2.5, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
        data = DataRoot(tmp_path / "data")
        run = MadeUpRun(data, make_pose(turns, along_a_line), map_S_sfm, rng.normal(size=(20, 3)) * 5)
        captures = data.captures("place")
        captures.mkdir(parents=True)
        for i in range(FRAMES):
            run.pictures.append(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
            cv2.imwrite(str(captures / f"{i}.png"), run.pictures[-1][..., ::-1])
        run.run(*stages)
        return run

    return make
