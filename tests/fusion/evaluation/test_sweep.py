"""Sweeps over the rule's thresholds: the same figures as the frame-by-frame evaluation."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import evaluate, joined_walks
from groundwalk.fusion.evaluation.sweep import VALUES, around, sweep, write_sweep_figure
from groundwalk.fusion.files.walks import Inputs
from groundwalk.fusion.methods.paper_rule import PaperRuleOptions
from tests.fusion.tables import tables

INPUTS = Inputs("Place", *tables([1, 2], ("PN", "MS-T")))
WALKS = {("Place", model): joined.walks for model, joined in joined_walks(INPUTS, ["test"])}


@pytest.mark.parametrize("changed", [{}, {"n": 3, "d_th_m": 0.2}, {"o_th_deg": 8.0, "gamma": 0.999}])
def test_a_setting_has_the_figures_of_the_evaluation(changed: dict[str, Any]) -> None:
    options = {"paper_rule": changed}
    summary = evaluate([INPUTS], FuseSettings(methods=["paper_rule"], options=options)).tables["summary"]
    stepped = summary[summary["scored"] == "method"].set_index(["model", "subset"])
    swept = sweep(WALKS, [s for s in around(PaperRuleOptions(**changed)) if s.varied == "n"])
    swept = swept[swept["n"] == changed.get("n", 2)].set_index(["model", "subset"])
    assert len(swept) == 4
    for key, row in swept.iterrows():
        for figure in ("frames", "answered", "total", "position_mean_m", "rotation_median_deg", "medium_pct"):
            assert row[figure] == pytest.approx(stepped.loc[key, figure], nan_ok=True), (key, figure)


def test_one_threshold_is_changed_at_a_time() -> None:
    assert all(s.options.n == 4 for s in around(PaperRuleOptions(n=4)) if s.varied != "n")
    default = PaperRuleOptions().model_dump()
    assert all(default[name] in values for name, values in VALUES.items())


def test_names_with_dollars_are_no_formulas(tmp_path: Path) -> None:
    options = PaperRuleOptions()
    figures = {"position_mean_m": 1.0, "rotation_mean_deg": 1.0, "frames_pct": 50.0, "coverage_pct": 50.0}
    keys = {"scene": "$\\frac$", "model": "PN", "subset": "all"}
    rows = [keys | figures | {"varied": s.varied} | {n: getattr(s.options, n) for n in VALUES} for s in around(options)]
    write_sweep_figure(pd.DataFrame(rows), tmp_path / "sweep.svg")
    assert (tmp_path / "sweep.svg").is_file()
