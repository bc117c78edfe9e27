"""How much the paper's rule depends on its thresholds: one at a time is changed, over the same walks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.fusion.evaluation.fuse import Run, error_rows, fuse, stacked
from groundwalk.fusion.evaluation.summary import figures
from groundwalk.fusion.methods.paper_rule import PaperRule, PaperRuleOptions
from groundwalk.fusion.walk import Walk
from groundwalk.scoring.scores import SUBSETS
from groundwalk.store import colours

# The paper's values are among them.
VALUES: dict[str, tuple[float, ...]] = {
    "n": (1, 2, 3, 4, 5),
    "d_th_m": (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2),
    "o_th_deg": (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0),
    "gamma": (0.9, 0.95, 0.98, 0.99, 0.995, 0.999),
}


class Setting(NamedTuple):
    """Options of the rule; `varied` names the threshold that differs from the others."""

    options: PaperRuleOptions
    varied: str


def around(options: PaperRuleOptions) -> list[Setting]:
    """One threshold at a time, from the given options."""
    base = options.model_dump()
    return [Setting(PaperRuleOptions(**base | {name: v}), name) for name, tried in VALUES.items() for v in tried]


def sweep(walks: Mapping[tuple[str, str], Sequence[Walk]], settings: Sequence[Setting]) -> pd.DataFrame:
    """Table fuse.sweep: the figures of each setting over the walks of each scene and model, by which they are keyed."""
    tasks = ((key, setting) for key in walks for setting in settings)
    return pd.DataFrame([row for key, setting in tasks for row in _rows(key, walks[key], setting)])


def _rows(key: tuple[str, str], walks: Sequence[Walk], setting: Setting) -> list[dict[str, Any]]:
    """The paper's rp+opt, and all frames in time."""
    run = Run("", "", key[1])
    errors = stacked(error_rows(fuse(run, walk, PaperRule(setting.options))) for walk in walks)
    row = {"scene": key[0], "model": key[1], "varied": setting.varied}
    row |= {threshold: getattr(setting.options, threshold) for threshold in VALUES}
    answered = errors[errors["status"].isin(SUBSETS["rp+opt"])]
    return [
        row | {"subset": subset} | figures(frames, prefix, len(errors))
        for subset, frames, prefix in (("rp+opt", answered, ""), ("all", errors, "live_"))
    ]


_LABELS = {"n": "N", "d_th_m": "$d_{th}$ (m)", "o_th_deg": "$o_{th}$ (°)", "gamma": "$\\gamma$"}
_ROWS = (
    ("position_mean_m", "mean position error (m)"),
    ("rotation_mean_deg", "mean rotation error (°)"),
    ("frames_pct", "frames with a pose (%)"),
)
_LINES = {"rp+opt": ("-", "reliable and optimised"), "all": ("--", "all frames, in time")}
_COLOURS = tuple(colours.LOCALISERS.values())


def write_sweep_figure(sweep: pd.DataFrame, path: Path) -> None:
    """Draw the rows of fuse.sweep that vary one threshold: a column each, a colour for each scene and model; the value
    in force elsewhere is dotted. The suffix of `path` is the format."""
    groups = list(sweep.groupby(["scene", "model"], sort=False))
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    axes = figure.subplots(len(_ROWS), len(VALUES), sharey="row", sharex="col")
    for column, threshold in enumerate(VALUES):
        in_force = sweep.loc[sweep["varied"] != threshold, threshold].iloc[0]
        for row, (name, label) in enumerate(_ROWS):
            ax = axes[row, column]
            for number, (key, rows) in enumerate(groups):
                who = " ".join(map(str, key)).replace("$", r"\$")  # no formula
                _draw(ax, rows[rows["varied"] == threshold], threshold, name, number, who)
            ax.axvline(in_force, color="grey", lw=0.8, ls=":")
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
    for subset, (dashes, frames) in _LINES.items():
        part = rows[rows["subset"] == subset].sort_values(threshold)
        values = part["coverage_pct"] * part["frames_pct"] / 100 if name == "frames_pct" else part[name]
        ax.plot(part[threshold], values, color=colour, ls=dashes, marker="o", ms=3, lw=1.2, label=f"{who}: {frames}")
