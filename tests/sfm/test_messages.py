"""What the stage says of the cameras."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.messages import report_cameras
from tests.known import filled


@pytest.mark.parametrize(("sd", "verb"), [(0.001, "are likely"), (0.02, "may be"), (np.nan, "may be")])
def test_focal_lengths_are_likely_wrong_where_images_are_sure_of_it(sd: float, verb: str) -> None:
    said: list[str] = []
    run: Any = type("Run", (), {"say": said.append})
    intrinsics = filled("sfm", "intrinsics", 1, session_id="walk", focal_scale=1.05, focal_scale_sd=sd)
    frames = pd.DataFrame({"session_id": ["walk"], "focal_sd": [0.0], "fx": [1400.0]})
    report_cameras(run, filled("sfm", "lenses", 0), intrinsics, frames)
    assert len(said) == 1 and f"focal lengths {verb} wrong" in said[0]
    # The limit may be larger in the settings of align.
    assert "max_focal_error" in said[0] and "be larger than that: else align refuses" in said[0]
