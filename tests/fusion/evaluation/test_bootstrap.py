"""Confidence intervals: their values are the summary's, and they cover what other sessions would have given."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import evaluate
from groundwalk.fusion.evaluation.summary import intervals
from groundwalk.fusion.files.walks import Inputs
from groundwalk.scoring.bootstrap import DRAWS
from tests.fusion.tables import tables

METHODS = ["raw", "paper_rule"]


def errors_of(sessions: list[np.ndarray]) -> pd.DataFrame:
    """Rows of fuse.errors of one method whose position errors are given by session; NaN is a frame without a pose."""
    rows = []
    for number, position_m in enumerate(sessions):
        part = pd.DataFrame({"live_position_m": position_m, "live_rotation_deg": 2 * position_m})
        part["raw_position_m"], part["raw_rotation_deg"] = part["live_position_m"], part["live_rotation_deg"]
        part["frame_id"] = [f"s{number}/{i:06d}" for i in range(len(part))]
        rows.append(part.assign(session_id=f"s{number}", method="raw", options="{}", model="PN", scene="Place"))
    return pd.concat(rows, ignore_index=True).assign(status="predicted", quality=None)


def row_of(found: pd.DataFrame, figure: str) -> Any:
    """The figure's row of all frames."""
    return found.set_index(["subset", "figure"]).loc[("all", figure)]


def test_values_are_those_of_the_summary() -> None:
    results = evaluate([Inputs("Place", *tables([1, 2, 3]))], FuseSettings(methods=METHODS))
    summary = results.tables["summary"]
    ours = summary[summary["scored"] == "method"].set_index(["method", "subset"])
    for row in results.tables["intervals"].to_dict("records"):
        expected = ours.loc[(row["method"], row["subset"]), row["figure"]]
        assert row["value"] == pytest.approx(expected) or (pd.isna(row["value"]) and pd.isna(expected)), row
        if not pd.isna(row["low"]) and not pd.isna(row["value"]):
            assert row["low"] <= row["value"] + 1e-9
        assert row["sessions"] == 3 and row["draws"] == 10


def test_two_sessions_give_the_two_sessions() -> None:
    rng = np.random.default_rng(0)
    sessions = [rng.uniform(0, 1, 40), rng.uniform(1, 2, 40)]
    found = row_of(intervals(errors_of(sessions)), "position_mean_m")
    assert (found["low"], found["high"]) == pytest.approx([s.mean() for s in sessions])
    assert found["draws"] == 3


def test_one_session_has_no_interval() -> None:
    found = intervals(errors_of([np.linspace(0, 1, 9)]))
    assert found["low"].isna().all() and found["high"].isna().all() and found["value"].notna().all()


def test_levels_leave_out_uncertain_ground_truth() -> None:
    errors = errors_of([np.array([0.1, 0.1, 9.0]), np.array([0.1, 9.0, 9.0])])
    errors["quality"] = ["A", "C", "B", "A", "A", "C"]
    high = row_of(intervals(errors), "high_pct")
    assert (high["value"], high["low"], high["high"]) == (50, 50, 50)
    nothing = intervals(errors.assign(quality="C")).set_index(["subset", "figure"]).loc["all"]
    assert nothing.loc["high_pct", ["value", "low", "high"]].isna().all()
    assert nothing.loc["position_mean_m", "value"] == pytest.approx(np.mean([0.1, 0.1, 9.0, 0.1, 9.0, 9.0]))


def test_missing_frames_make_a_median_infinite_where_half_are_missing() -> None:
    found = intervals(errors_of([np.array([0.1, 0.2, np.nan]), np.array([np.nan, np.nan, 0.3])]))
    median = row_of(found, "position_median_m")
    assert pd.isna(median["value"]) and median["low"] == pytest.approx(0.2) and pd.isna(median["high"])
    assert DRAWS >= 1000
