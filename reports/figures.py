"""The report's figures, each from tables alone, one panel below the other: a column's width is what a phone and a
paper have. Each function gives the name of a figure's files, its caption, and the figure."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from groundwalk.reports import style
from groundwalk.reports.inputs import SceneInputs
from groundwalk.store.choices import MapUnit

Named = tuple[str, str, Figure]


@dataclass(frozen=True)
class Picture:
    """A figure in the page: its SVG, and what it shows."""

    svg: str
    caption: str


def scene_figures(scene: SceneInputs, folder: Path) -> dict[str, list[Picture]]:
    """All figures of a scene, by the section of the page that they belong to, as far as its stages are finished;
    written into a folder."""
    pictures: dict[str, list[Picture]] = {"drift": [], "training": [], "errors": []}
    with style.applied():
        for part, has_data, draw in (
            ("drift", len(scene.residuals) > 0 and scene.vio_sessions, drift),
            ("training", len(scene.history) > 0, learning_curves),
            ("errors", "fuse" in scene.stages, error_distributions),
        ):
            if has_data:
                name, caption, figure = draw(scene)
                style.mark(figure, f"{scene.name}: {scene.marker()}")  # a picture is passed on without its caption
                pictures[part].append(Picture(style.save(figure, folder, f"{scene.name}-{name}"), caption))
    return pictures


def drift(scene: SceneInputs) -> Named:
    """VIO against ground truth: relative position error over travelled distances, by session and of all."""
    figure, (ax,) = style.new_figure(1, 2.2)
    rows = scene.drift[scene.drift["definition"] == "distance_position"].sort_values("interval")
    for session_id, of_session in rows.groupby("session_id"):
        if session_id != "all":
            ax.plot(of_session["interval"], of_session["median"], color=style.VIO, lw=0.7, alpha=0.7)
    pooled = rows[rows["session_id"] == "all"]
    ax.plot(pooled["interval"], pooled["median"], color=style.VIO, lw=2, marker="o", ms=4, label="median, all sessions")
    p95: Any = {"color": style.VIO, "lw": 1, "ls": "--", "marker": "o", "ms": 3, "label": "95th percentile"}
    ax.plot(pooled["interval"], pooled["p95"], **p95)
    ax.set(title="VIO drift over distance", xlabel="travelled (m)", ylabel="position error (%)")
    ax.set_ylim(bottom=0)
    if len(pooled):
        ax.legend(fontsize=7.5)
    else:
        ax.text(0.5, 0.5, "no walk is long enough", transform=ax.transAxes, ha="center")
        ax.set(xticks=[], yticks=[])
    caption = (
        f"{scene.name}: VIO's motion over a distance against the ground truth's; thin: the median of each session."
    )
    return "vio-drift", caption, figure


def learning_curves(scene: SceneInputs) -> Named:
    """Loss on training frames and median errors on held-out ones, an epoch at a time; the selected epoch is marked."""
    figure, axes = style.new_figure(3, 1.6, sharex=True)
    colours = style.model_colours(scene)
    panels = (
        ("train_loss", "Training loss", ""),
        ("val_position_m", "Held-out position", f"median error ({scene.unit.symbol})"),
        ("val_rotation_deg", "Held-out rotation", "median error (°)"),
    )
    for model, history in scene.history.groupby("model", sort=False):
        colour = colours[str(model)]
        history = history.sort_values("epoch")
        selected = history[history["selected"]]
        for ax, (column, _, _) in zip(axes, panels, strict=True):
            ax.plot(history["epoch"], history[column], color=colour, label=scene.label(str(model)))
            ax.plot(selected["epoch"], selected[column], "o", color=colour, ms=5, zorder=3)
    for ax, (_, title, unit) in zip(axes, panels, strict=True):
        ax.set(title=title, ylabel=unit)
        ax.set_xlim(left=0)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for ax in axes[1:]:
        ax.set_ylim(bottom=0)
    axes[-1].set_xlabel("epoch")
    axes[0].legend(fontsize=7.5)
    caption = f"{scene.name}: learning curves on frames of the training walks; dots mark the selected epoch."
    return "learning-curves", caption, figure


def error_distributions(scene: SceneInputs) -> Named:
    """How many test frames lie within an error, a missing pose being a failure: each model alone, and fused in time."""
    figure, axes = style.new_figure(2, 2.1)
    colours = style.model_colours(scene)
    shown = scene.compared
    quantities = (("position", "m", (0.25, 0.5, 5.0)), ("rotation", "deg", (2.0, 5.0, 10.0)))
    for ax, (quantity, unit, levels) in zip(axes, quantities, strict=True):
        for level in levels if scene.unit is MapUnit.METRE else ():
            ax.axvline(level, color=style.NEUTRAL, lw=0.8, ls=(0, (1, 2)))
        for model in scene.models:
            alone = shown[shown["model"] == model].drop_duplicates("frame_id")
            _cumulative(ax, alone, f"raw_{quantity}_{unit}", colours[model], "--" if scene.fuses else "-")
            if scene.fuses:
                fused = shown[(shown["model"] == model) & (shown["method"] == scene.best(model))]
                _cumulative(ax, fused, f"live_{quantity}_{unit}", colours[model], "-")
        ax.set(xscale="log", ylim=(0, 102), ylabel="frames within (%)")
        ax.set_xlabel(f"{quantity} error ({scene.unit.symbol if unit == 'm' else '°'})")
        style.log_axis(ax.xaxis)
    for model in scene.models:
        axes[0].plot([], [], color=colours[model], label=scene.label(model))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=7.5)
    caption = f"{scene.name}: share of test frames within an error; a frame without a pose counts as failed."
    if scene.fuses:
        names = ", ".join(scene.label(m) + scene.method_labels.get(scene.best(m) or "", "") for m in scene.models)
        which = "all frames with VIO" if scene.unfused_sessions else "all frames"
        over = "the same" if scene.unfused_sessions else "all test frames"
        caption += f" Dashed: alone, over {over}; solid: {names} in time, {which}."
    if scene.unit is MapUnit.METRE:
        caption += " Dotted: the accuracy levels."
    return "error-distribution", caption, figure


def _cumulative(ax: Axes, errors: pd.DataFrame, column: str, colour: str, dashes: str) -> None:
    test = errors.loc[errors["split"] == "test", column]
    known = np.sort(test[np.isfinite(test)].to_numpy(float))
    if len(known):
        share = 100 * np.arange(1, len(known) + 1) / len(test)
        # A zero has no place on the logarithmic axis.
        ax.step(np.maximum(known, 1e-3), share, where="post", color=colour, ls=dashes)
