"""The look of all figures."""

from pathlib import Path

import matplotlib as mpl

from groundwalk.reports import style


def test_a_figure_is_the_same_whatever_a_matplotlibrc_says(tmp_path: Path) -> None:
    def drawn() -> str:
        with style.applied():
            figure, (ax,) = style.new_figure(1, 2.0)
            ax.plot([1, 2], [3, 4])
            return style.save(figure, tmp_path, "line")

    expected = drawn()
    with mpl.rc_context({"axes.facecolor": "red", "lines.marker": "o", "axes.formatter.limits": (0, 0)}):
        assert drawn() == expected
