"""What differs between runs of the same captures: settings and inputs, and figures, as far as that is beyond noise.

Figures are paired, over the frames that both runs have. How far a difference would move with other frames is found by
a block bootstrap over walks: neighbouring frames share their error, and so does a walk, of which there are few.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from groundwalk.reports import style
from groundwalk.reports.grids import EMPTY, Grid, html_table, plain_grid
from groundwalk.reports.templating import plain_page
from groundwalk.scoring.bootstrap import DRAWS, drawn_figures, draws, middle
from groundwalk.scoring.errors import sure_enough
from groundwalk.store.choices import MapUnit
from groundwalk.store.tables import poses_of

BLOCK = 10
"""Consecutive frames of a walk that are drawn together."""
MIN_BLOCKS = 3
_TRUTH, _ALONE = "ground truth", "raw"
_KEYS = ["scene", "session_id", "t_ns", "frame_id"]  # of a frame, by which runs are paired
# What is compared, of drawn_figures, and what it's called of each.
_COMPARED = ("coverage_pct", "position_median_m", "rotation_median_deg")
_NAMES = {
    _TRUTH: ("frames with one (%)", "sigma, position", "sigma, rotation (°)"),
    _ALONE: ("coverage (%)", "median position", "median rotation (°)"),
}


@dataclass(frozen=True)
class ComparedRun:
    """A run as it takes part: its name, the manifests of its stages, and its tables, which are empty
    where a stage isn't finished. `unit` is that of the map."""

    name: str
    manifests: dict[str, dict[str, Any]]
    unit: MapUnit
    ground_truth: pd.DataFrame
    errors: pd.DataFrame
    validation: pd.DataFrame


@dataclass(frozen=True)
class Difference:
    """A figure of a run beside the first one's, over the frames that both have; `low` and `high` bound the difference,
    NaN where there are too few frames to tell."""

    run: str
    subject: str
    figure: str
    frames: int
    before: float
    after: float
    low: float
    high: float
    more_is_better: bool

    @property
    def is_clear(self) -> bool:
        """Whether the difference is larger than noise."""
        return self.low > 0 or self.high < 0

    @property
    def is_worse(self) -> bool:
        return self.is_clear and (self.after < self.before) == self.more_is_better

    @property
    def verdict(self) -> str:
        if np.isnan(self.low):
            return "too few frames to tell"
        return ("worse" if self.is_worse else "better") if self.is_clear else "the same"

    @property
    def percent(self) -> float:
        """The change, in percent of what it was."""
        return 100 * (self.after - self.before) / self.before if self.before else float("nan")

    def is_worse_by(self, percent: float) -> bool:
        """Whether it is clearly worse, and by more than that; an infinite error is."""
        return self.is_worse and not abs(self.percent) <= percent


@dataclass(frozen=True)
class Missing:
    """How many of the `of` frames that the run `has` has of a subject are missing in another."""

    run: str
    subject: str
    frames: int
    of: int
    has: str

    def __str__(self) -> str:
        return f"missing: {self.run}: {self.subject}: {self.frames} of the {self.of} frames of {self.has}"


@dataclass(frozen=True)
class _Subject:
    """What runs are compared by: its name, the kind of its figures, and its frames in the first and the other run."""

    name: str
    kind: str
    first: pd.DataFrame
    other: pd.DataFrame


def differences(first: ComparedRun, other: ComparedRun) -> list[Difference]:
    """The figures of two runs, ground truth's and then each localiser's, alone and as the first run's report shows it
    fused, as far as both have them; of positions where both are in one unit."""
    figures = [name for name in _COMPARED if "position" not in name or not why_no_positions(first, other)]
    return [found for subject in _subjects(first, other) for found in _paired(other.name, subject, figures)]


def missing(first: ComparedRun, other: ComparedRun) -> list[Missing]:
    """What the other run lacks of what `differences` compares of the first."""
    found = []
    for subject in _subjects(first, other):
        merged = subject.first[_KEYS].merge(subject.other[_KEYS], how="left", indicator=True)
        if lost := int((merged["_merge"] == "left_only").sum()):
            found.append(Missing(other.name, subject.name, lost, len(merged), first.name))
    return found


def why_no_positions(first: ComparedRun, other: ComparedRun) -> str:
    """Why positions of two runs aren't compared; empty where they are. Each map of SfM has a unit of its own."""
    before, after = (poses_of(run.ground_truth, "map_cam") for run in (first, other))
    is_one_map = len(before) > 0 and np.array_equal(before, after, equal_nan=True)
    if first.unit is other.unit and (first.unit is not MapUnit.SFM or is_one_map):
        return ""
    units = f"{other.name} is in {other.unit}, {first.name} in {first.unit}"
    own = ", which is another in each map" if first.unit is other.unit else ""
    return f"positions aren't compared: {units}{own}"


def lost_scale(first: ComparedRun, other: ComparedRun) -> bool:
    """Whether the first run's positions are in metres, and the other's aren't."""
    return first.unit is MapUnit.METRE and other.unit is not MapUnit.METRE


def _subjects(first: ComparedRun, other: ComparedRun) -> Iterator[_Subject]:
    """The first run's: ground truth, and each model alone and with the method that is ahead on frames held out of
    training."""
    truths = (run.ground_truth for run in (first, other))
    sigmas = (t.assign(scene="", position=t["position_sd_m"], rotation=t["rotation_sd_deg"]) for t in truths)
    yield _Subject(_TRUTH, _TRUTH, *sigmas)
    ahead = first.validation[first.validation["ahead"].astype(bool) & (first.validation["method"] != _ALONE)]
    for model in dict.fromkeys(first.errors["model"]):
        for method in (_ALONE, *ahead.loc[ahead["model"] == model, "method"].head(1)):
            name = f"{model}, alone" if method == _ALONE else f"{model} with {method}"
            yield _Subject(name, _ALONE, *(_errors(run.errors, model, method) for run in (first, other)))


def _errors(errors: pd.DataFrame, model: str, method: str) -> pd.DataFrame:
    """The errors in time of test frames."""
    rows = errors[(errors["model"] == model) & (errors["split"] == "test")]
    if method == _ALONE:  # which stands by each method's
        rows, prefix = rows.drop_duplicates(["scene", "frame_id"]), "raw_"
    else:
        rows, prefix = rows[rows["method"] == method], "live_"
    return rows.assign(position=rows[f"{prefix}position_m"], rotation=rows[f"{prefix}rotation_deg"])


def _paired(run: str, subject: _Subject, figures: list[str]) -> Iterator[Difference]:
    columns = [*_KEYS, "position", "rotation", "quality"]
    both = subject.first[columns].merge(subject.other[columns], on=_KEYS, suffixes=("_0", "_1")).sort_values(_KEYS)
    if both.empty:
        return
    walks = both.groupby(["scene", "session_id"])
    blocks = pd.factorize(walks.ngroup() * len(both) + walks.cumcount() // BLOCK)[0]
    weights = draws(int(blocks.max()) + 1)[:, blocks]
    first, other = (
        dict(
            drawn_figures(
                both[f"position_{side}"].to_numpy(float),
                both[f"rotation_{side}"].to_numpy(float),
                sure_enough(both[f"quality_{side}"]),
                weights,
            )
        )
        for side in (0, 1)
    )
    for figure in figures:
        name = _NAMES[subject.kind][_COMPARED.index(figure)]
        low, high = np.nan, np.nan
        if blocks.max() + 1 >= MIN_BLOCKS:
            before, after = first[figure][1:], other[figure][1:]  # of which two infinite errors are alike
            low, high = middle(np.subtract(after, before, out=np.zeros(len(after)), where=after != before))
        numbers = (float(first[figure][0]), float(other[figure][0]), low, high)
        yield Difference(run, subject.name, name, len(both), *numbers, more_is_better=figure == "coverage_pct")


def settings_that_differ(runs: list[ComparedRun]) -> Grid | None:
    """Settings, versions, seeds and captures that aren't the same in all runs; None where there are none."""
    facts = [dict(_facts(run)) for run in runs]
    names = dict.fromkeys(name for of_run in facts for name in of_run)
    rows = [(*name, *values) for name in names if len({*(values := [f.get(name, EMPTY) for f in facts])}) > 1]
    heads = " | ".join(["stage", "what", *(run.name.replace(" | ", "|") for run in runs)])
    caption = "Settings, versions, seeds, captures and files that aren't the same in all runs."
    return plain_grid("settings", "What was done differently", caption, heads, rows, 2 + len(runs))


def _facts(run: ComparedRun) -> Iterator[tuple[tuple[str, str], str]]:
    for stage, manifest in run.manifests.items():
        for name in ("version", "seed", "profile", "git_revision"):
            yield (stage, name), str(manifest.get(name))
        for name, hashes in manifest.get("inputs", {}).items():
            if "/" not in name:  # what another stage made follows from that stage's
                is_digest = isinstance(hashes, dict)
                yield (stage, name), str(hashes.get("sha256", hashes))[:12] if is_digest else str(hashes)[:80]
        yield from (((stage, name), text) for name, text in _flat(manifest.get("settings", {})))


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, str(value)


def figures_grid(found: list[Difference], unit: str) -> Grid | None:
    """All figures side by side, and which differ by more than noise."""
    rows = []
    for d in found:
        figure = d.figure if d.figure.endswith(")") else f"{d.figure} ({unit})"
        values = [f"{v:.4g}" if np.isfinite(v) else EMPTY for v in (d.before, d.after)]
        change = f"{d.percent:+.1f}" if np.isfinite(d.percent) else EMPTY
        bounds = EMPTY if np.isnan(d.low) else f"{d.low:+.3g} to {d.high:+.3g}"
        rows.append([d.run, d.subject, figure, d.verdict, d.frames, *values, change, bounds])
    heads = "run | of | figure | against the first | frames | first | this | change (%) | 95 % of the difference"
    caption = (
        f"Paired, over the frames that both runs have; {EMPTY}: infinite, as most frames have no pose. The same: the "
        f"difference isn't larger than noise, by drawing blocks of {BLOCK} consecutive frames of a walk again, {DRAWS} "
        "times."
    )
    return plain_grid("figures", "Figures", caption, heads, rows, 4)


def missing_grid(lacking: list[Missing]) -> Grid | None:
    """The frames that only one of two runs has."""
    rows = [[m.run, m.subject, m.has, m.frames, m.of] for m in lacking]
    caption = "Frames that a run has and the other lacks; no figure counts them."
    heads = "missing in | of | has them | frames missing | frames there"
    return plain_grid("missing", "What only one of the runs has", caption, heads, rows, 3)


def picture(found: list[Difference], folder: Path) -> str:
    """The changes in percent with their intervals, as SVG, of several runs only those larger than noise, which are
    dark; empty where there are none."""
    several = len({d.run for d in found}) > 1
    shown = [d for d in found if np.isfinite([d.percent, d.low, d.high]).all() and (d.is_clear or not several)]
    if not shown:
        return ""
    with style.applied():
        figure, (ax,) = style.new_figure(1, 0.17 * max(len(shown), 4) + 0.5)
        ax.set_xscale("symlog", linthresh=10)
        for y, d in enumerate(shown):
            low, high = (100 * bound / d.before for bound in (d.low, d.high))
            colour = style.INK if d.is_clear else style.NEUTRAL
            ax.plot([low, high], [y, y], color=colour, lw=1.2)
            ax.plot(d.percent, y, "o", color=colour, ms=4)
        labels = [f"{d.run + ': ' if several else ''}{d.subject}, {d.figure.partition(' (')[0]}" for d in shown]
        ax.axvline(0, color=style.NEUTRAL, lw=0.8)
        ax.set(yticks=range(len(shown)), yticklabels=labels, xlabel="change (%)")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.invert_yaxis()
    return style.save(figure, folder, "compare")


def comparison_page(runs: list[ComparedRun], found: list[Difference], lacking: list[Missing], folder: Path) -> str:
    """The page as HTML; `folder` is for the picture's files."""
    banner = Markup('<p class="banner">{}</p>')
    parts = []
    if len({str(run.manifests.get("import", {}).get("inputs")) for run in runs}) > 1:
        parts.append(banner.format("The captures differ: frames are paired by their names, whatever they show."))
    for why in filter(None, (why_no_positions(runs[0], other) for other in runs[1:])):
        parts.append(banner.format(f"{why[0].upper()}{why[1:]}."))
    if lacking:
        parts.append(banner.format("Only one of the runs has some frames: all figures are over the others."))
    clear = sum(d.is_clear for d in found)
    parts.append(Markup(f"<p>{clear or 'None'} of {len(found)} figures differ by more than noise.</p>"))
    if drawn := picture(found, folder):
        caption = (
            "Each figure's change with its 95 % interval; grey: not larger than noise."
            " Of coverage and frames with ground truth more is better, of all others less."
        )
        shown = Markup('<figure class="picture wide">{}<figcaption>{}</figcaption></figure>')
        parts.append(shown.format(Markup(drawn), caption))
    grids = (missing_grid(lacking), figures_grid(found, runs[0].unit.symbol), settings_that_differ(runs))
    parts += map(html_table, grids)
    others = runs[1].name if len(runs) == 2 else f"{len(runs) - 1} other runs"
    return plain_page(f"{runs[0].name} against {others}", "comparison", parts)
