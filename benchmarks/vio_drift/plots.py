"""Pictures of docs/explanation/vio-drift.md: how errors grow in the recordings and in simulated walks past
the same tags."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from benchmarks.vio_drift.estimators import closures, heading_changes
from benchmarks.vio_drift.recordings import TagWalk
from benchmarks.vio_drift.rewalk import rewalk
from groundwalk.geometry.poses import Array
from groundwalk.simulation.vio import VioModel

_REPEATS = 60
_BINS_M = np.array([0, 20, 50, 80, 120, 180, 250, 400])
_COLOURS = ["#0072b2", "#56b4e9", "#009e73", "#d55e00", "#e69f00"]


def write_plots(walks: Sequence[TagWalk], model: VioModel, tag_m: Array, folder: Path) -> None:
    """Writes vio-drift-growth.png and vio-drift-walks.png; tags are seen with noise of spread tag_m (3,)."""
    folder.mkdir(parents=True, exist_ok=True)
    places = [_places(walk, walks) for walk in walks]
    repeats = [
        [rewalk(w, place, tag_m, 100 * seed + i, model) for i, (w, place) in enumerate(zip(walks, places, strict=True))]
        for seed in range(_REPEATS)
    ]
    _growth(walks, repeats, folder / "vio-drift-growth.png")
    _walks(walks, repeats[:5], folder / "vio-drift-walks.png")


def _places(walk: TagWalk, walks: Sequence[TagWalk]) -> dict[int, Array]:
    """Where the tags of a walk hang: as the walk with the least horizontal closures past all of them saw them first."""
    rivals = [w for w in walks if set(walk.tag) <= set(w.tag)]
    steadiest = min(rivals, key=lambda w: float(np.median(closures(w)[:, 1])))
    return {int(tag): steadiest.position[np.flatnonzero(steadiest.tag == tag)[0]] for tag in np.unique(steadiest.tag)}


def _growth(walks: Sequence[TagWalk], repeats: Sequence[Sequence[TagWalk]], path: Path) -> None:
    def off(column: int) -> Callable[[TagWalk], Array]:
        return lambda walk: closures(walk)[:, [0, column]]

    panels: list[tuple[str, str, Callable[[TagWalk], Array]]] = [
        ("Heading between two tags, walked again", "change, deg", heading_changes),
        ("Back at a tag: horizontally off", "distance, m", off(1)),
        ("Back at a tag: vertically off", "distance, m", off(2)),
    ]
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    for axis, (title, unit, measure) in zip(axes, panels, strict=True):
        _band(axis, np.concatenate([measure(w) for walk_set in repeats for w in walk_set]))
        for walk, colour in zip(walks, _COLOURS, strict=False):
            axis.plot(*measure(walk).T, "o", ms=3, color=colour, label=f"recorded: {walk.name}")
        axis.set(title=title, xlabel="path walked between, m", ylabel=unit, yscale="log", xlim=(0, _BINS_M[-1]))
        axis.set_ylim(bottom=1e-2 if unit.endswith("deg") else 1e-3)
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _band(axis: Axes, points: Array) -> None:
    middles = (_BINS_M[1:] + _BINS_M[:-1]) / 2
    inside = [points[(points[:, 0] >= a) & (points[:, 0] < b), 1] for a, b in pairwise(_BINS_M)]
    low, middle, high = np.array([np.percentile(values, [5, 50, 95]) for values in inside]).T
    axis.fill_between(middles, low, high, color="0.8", label="simulated, 5 to 95 %", lw=0)
    axis.plot(middles, middle, color="0.35", lw=1.5, label="simulated, median")


def _walks(walks: Sequence[TagWalk], repeats: Sequence[Sequence[TagWalk]], path: Path) -> None:
    figure, axes = plt.subplots(2, len(walks), figsize=(13, 6), layout="constrained")
    for column, walk in enumerate(walks):
        simulated = repeats[column % len(repeats)][column]
        for axis, drawn, kind in zip(axes[:, column], (walk, simulated), ("recorded", "simulated"), strict=True):
            xz = drawn.position[:, [0, 2]] - drawn.position[0, [0, 2]]
            axis.plot(*xz.T, color="0.75", lw=0.8)
            axis.scatter(*xz.T, c=drawn.along_m, cmap="viridis", s=12, zorder=2)
            axis.set_aspect("equal", adjustable="datalim")
            axis.set_title(f"{walk.name}, {kind}", fontsize=8)
            axis.tick_params(labelsize=7)
    figure.supxlabel("x, m (tags as seen from above; dark: early, light: late)", fontsize=9)
    figure.supylabel("z, m", fontsize=9)
    figure.savefig(path, dpi=90)
    plt.close(figure)
