"""The sensitivity figure: how errors and coverage move with each threshold of the paper's rule."""

from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.fusion.evaluation.sweep import VALUES
from groundwalk.store import colours

_LABELS = {"n": "N", "d_th_m": "$d_{th}$ (m)", "o_th_deg": "$o_{th}$ (°)", "gamma": "$\\gamma$"}
_ROWS = (
    ("position_mean_m", "mean position error (m)"),
    ("rotation_mean_deg", "mean rotation error (°)"),
    ("frames_pct", "frames with a pose (%)"),
)
_SUBSETS = {"rp+opt": ("-", "reliable and optimised"), "all": ("--", "all frames, in time")}
_COLOURS = tuple(colours.LOCALISERS.values())


def write_sweep_figure(sweep: pd.DataFrame, defaults: dict[str, float], path: Path) -> None:
    """Draw the rows of fuse.sweep that vary one threshold: a column each, a colour for each scene and model; the value
    in force elsewhere is dotted. The suffix of `path` is the format."""
    single = sweep[sweep["varied"] != ""]
    groups = list(single.groupby(["scene", "model"], sort=False))
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots(len(_ROWS), len(VALUES), sharey="row", sharex="col")
    for column, threshold in enumerate(VALUES):
        for row, (name, label) in enumerate(_ROWS):
            ax = axes[row, column]
            for number, (key, rows) in enumerate(groups):
                _draw(ax, rows[rows["varied"] == threshold], threshold, name, number, " ".join(map(str, key)))
            ax.axvline(defaults[threshold], color="grey", lw=0.8, ls=":")
            ax.spines[["top", "right"]].set_visible(False)
            ax.set_ylim(bottom=0)
            if column == 0:
                ax.set_ylabel(label)
        axes[-1, column].set_xlabel(_LABELS[threshold])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    figure.savefig(path)


def _draw(ax: Axes, rows: pd.DataFrame, threshold: str, name: str, number: int, who: str) -> None:
    colour: Any = [part / 255 for part in _COLOURS[number % len(_COLOURS)]]
    for subset, (dashes, frames) in _SUBSETS.items():
        part = rows[rows["subset"] == subset].sort_values(threshold)
        values = part["coverage_pct"] * part["frames_pct"] / 100 if name == "frames_pct" else part[name]
        ax.plot(part[threshold], values, color=colour, ls=dashes, marker="o", ms=3, lw=1.2, label=f"{who}: {frames}")
