"""The figures of fusion's own tables show what the tables say."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.lines import Line2D

from groundwalk.reports import style
from groundwalk.reports.figures import confidence, costs
from groundwalk.reports.inputs import SceneInputs
from groundwalk.store.choices import MapUnit
from tests.reports.made_up_scenes import MODELS, MadeUpScene

NO_CARDS = {name: pd.DataFrame({"model": []}) for name in ("cards", "localisers")}


@pytest.fixture(scope="module")
def scene() -> SceneInputs:
    tables = MadeUpScene("Church", 0, train=60).tables()["fuse"]
    made = SimpleNamespace(
        unit=MapUnit.METRE,
        name="Church",
        evaluated_splits="val and test",
        models=list(MODELS),
        **NO_CARDS,
        label=str,
        best=lambda model: "mobilearloc",
        method_labels={"apr": "", "mobilearloc": "+VIO", "smoother": "+smoother"},
        intervals=tables["intervals"].astype({"high": float}),
        offline={"smoother"},
        raw_methods={"apr"},
        unfused_sessions=set(),
    )
    return cast(SceneInputs, made)


def along_x(line: Line2D) -> list[float]:
    return np.asarray(line.get_xdata(), float).tolist()


def along_y(line: Line2D) -> list[float]:
    return np.asarray(line.get_ydata(), float).tolist()


def test_intervals_stand_about_each_methods_mean(scene: SceneInputs) -> None:
    named = confidence(scene)
    positions = named.figure.axes[0]
    assert [t.get_text() for t in positions.get_yticklabels()] == [f"{m}{f}" for m in MODELS for f in ("", "+VIO")]
    span, middle = positions.lines[2:4]
    assert along_x(span) == pytest.approx([1.2, 1.95]) and along_x(middle) == [1.5]
    assert "all val and test frames" in named.caption and "their 2 sessions" in named.caption
    assert "3 ways" in named.caption
    # A bound that is infinite has no end to draw to, but its mean is there.
    assert np.isnan(along_x(positions.lines[0])[1]) and along_x(positions.lines[1]) == [2.0]


def test_costs_stand_where_bytes_time_and_the_median_error_say() -> None:
    errors = {"small": [0.01, 0.02, 0.03, np.nan, np.nan], "large": [1.0, 2.0, 3.0, 4.0, 5.0], "lost": [np.nan] * 5}
    scene = SimpleNamespace(
        unit=MapUnit.METRE,
        name="Church",
        models=list(errors),
        cards=pd.DataFrame({"model": ["large", "elsewhere"], "bytes": [2**24, None]}),
        localisers=pd.DataFrame({"model": ["small", "lost"], "bytes": [2**21, 2**21]}),
        raw_errors=lambda model: pd.DataFrame({"split": "test", "apr_position_m": errors[model]}),
        runtime_ms=lambda model: {"small": 50.0, "large": 10.0, "lost": 10.0}[model],
        label=str.upper,
    )
    bytes_, time = costs(cast(SceneInputs, scene)).figure.axes
    # A missing pose is a failure; a model whose median is one has no place.
    for ax, places in ((bytes_, [(2, 3), (16, 300)]), (time, [(50, 3), (10, 300)])):
        shown = np.array([(along_x(line)[0], along_y(line)[0]) for line in ax.lines])
        assert shown == pytest.approx(np.array(places))
        assert [text.get_text() for text in ax.texts] == ["SMALL", "LARGE"]


def test_a_figure_is_the_same_whatever_a_matplotlibrc_says(tmp_path: Path) -> None:
    def drawn() -> str:
        with style.applied():
            figure, (ax,) = style.new_figure(1, 2.0)
            ax.plot([1, 2], [3, 4])
            return style.save(figure, tmp_path, "line")

    expected = drawn()
    with mpl.rc_context({"axes.facecolor": "red", "lines.marker": "o", "axes.formatter.limits": (0, 0)}):
        assert drawn() == expected
