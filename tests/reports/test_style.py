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
from groundwalk.reports.figures import costs
from groundwalk.reports.inputs import SceneInputs
from groundwalk.store.choices import MapUnit


def along_x(line: Line2D) -> list[float]:
    return np.asarray(line.get_xdata(), float).tolist()


def along_y(line: Line2D) -> list[float]:
    return np.asarray(line.get_ydata(), float).tolist()


def test_costs_stand_where_bytes_time_and_the_median_error_say() -> None:
    errors = {"small": [0.01, 0.02, 0.03, np.nan, np.nan], "large": [1.0, 2.0, 3.0, 4.0, 5.0], "lost": [np.nan] * 5}
    scene = SimpleNamespace(
        unit=MapUnit.METRE,
        name="Church",
        models=list(errors),
        cards=pd.DataFrame({"model": ["large", "elsewhere"], "bytes": [2**24, None]}),
        localisers=pd.DataFrame({"model": ["small", "lost"], "bytes": [2**21, 2**21]}),
        raw_errors=lambda model: pd.DataFrame({"split": "test", "raw_position_m": errors[model]}),
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
