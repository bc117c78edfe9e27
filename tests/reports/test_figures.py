"""Figures: what is drawn side by side is of the same frames."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

from groundwalk.reports.figures import error_distributions
from groundwalk.reports.inputs import SceneInputs, compared
from groundwalk.store.choices import MapUnit


@pytest.mark.parametrize("unit", [MapUnit.METRE, MapUnit.SFM])
def test_alone_and_fused_are_over_the_same_frames_whatever_is_ahead(unit: MapUnit) -> None:
    """The regressor alone is ahead, and a walk without VIO is in no comparison."""
    rows = [("raw", walk, number) for walk in ("with", "without") for number in range(8)]
    rows += [("paper_rule", "with", number) for number in range(8)]
    errors = pd.DataFrame(rows, columns=["method", "session_id", "number"]).assign(model="PN", split="test")
    errors["frame_id"] = errors["session_id"] + errors["number"].astype(str)
    for column in ("raw_position_m", "live_position_m", "raw_rotation_deg", "live_rotation_deg"):
        errors[column] = 1.0 + errors["number"] + 10 * (errors["session_id"] == "without")
    nobody = pd.DataFrame({"model": []})
    made = SimpleNamespace(
        name="Hall", unit=unit, models=["PN"], localisers=nobody, cards=nobody, fuses=True, errors=errors,
        compared=compared(errors), unfused_sessions={"without"}, method_labels={"raw": ""},
        best=lambda model: "raw", label=lambda model: model,
    )  # fmt: skip
    _, caption, figure = error_distributions(cast(SceneInputs, made))
    levels = 3 if unit is MapUnit.METRE else 0
    for axes in figure.axes:
        alone, fused = axes.lines[levels : levels + 2]
        for line in (alone, fused):
            assert np.asarray(line.get_xdata()).tolist() == [1.0 + number for number in range(8)]
    assert ("accuracy levels" in caption) == (levels > 0)
