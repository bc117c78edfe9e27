"""The leaderboard as files: fusion.md, fusion.csv, and errors against how late an answer may be."""

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from groundwalk.fusion.evaluation.leaderboard import (
    ERRORS,
    KEY,
    LAGS_S,
    LATE,
    RAW,
    RULE,
    ahead,
    cases_in,
    cases_of_runs,
    entrants,
    ratios,
    scores,
)
from groundwalk.store import DataRoot, UserError
from groundwalk.store.checkout import git_revision
from groundwalk.store.files import make_writable

_PAGE, _TABLE, _FIGURE = "fusion.md", "fusion.csv", "fusion_lag.png"
_HEADER = """# Fusion methods beside each other

Written by `groundwalk leaderboard`; not to be edited. Errors are over all frames with ground truth, in time; a
frame without a pose counts as failed in medians, percentiles and levels, and means have the coverage beside them.
`/rule` is a mean error over the paper's rule's in the same scene with the same model, the geometric mean over scenes
and models. In bounds: share of errors within the method's 95 % bounds, mean over scenes (worst). Levels: (0.25 m, 2°),
(0.5 m, 5°), (5 m, 10°). Steps: processor time on one thread, which what else runs on the machine lengthens. Ahead is
the causal method whose mean errors are least (the geometric mean of position and rotation, over the coverage).
`fusion.csv` has every figure."""


def run_leaderboard(folders: Sequence[Path], data: Path, out: Path, methods: Sequence[str], processes: int) -> None:
    """Run it, write its files and print them. UserError where there is nothing to run on, or the folder `out` can't be
    made or has files of these names that no leaderboard wrote."""
    revision = git_revision()  # before the run: the checkout may move on meanwhile
    cases, sources = cases_of_runs(DataRoot(data))
    for folder in folders:
        more, lines = cases_in(folder)
        cases, sources = cases + more, sources + lines
    if not cases:
        raise UserError(
            "there is nothing to run on",
            where=data,
            found="; ".join(sources) or None,
            do="name a folder of predictions, or finish a run of a scene; the scene needs VIO",
        )
    _refuse_other_files(out)
    make_writable(out)
    print(write_leaderboard(out, scores(cases, entrants(methods), processes), sources, revision))


def _refuse_other_files(out: Path) -> None:
    page = out / _PAGE
    there = [path for path in (page, out / _TABLE, out / _FIGURE) if path.exists()]
    if there and not (page.is_file() and page.read_bytes().startswith(_HEADER.encode().splitlines()[0])):
        raise UserError(
            "the output folder holds a file that no leaderboard wrote",
            where=there[0],
            expected=f"a new folder, or one with {_PAGE} of an earlier leaderboard, whose files are replaced",
            do="name another folder with --out",
        )


def write_leaderboard(out: Path, rows: pd.DataFrame, sources: list[str], revision: str) -> str:
    """Write fusion.md, fusion.csv and, with lags, fusion_lag.png into the folder; returns what stands in fusion.md."""
    head = {
        "revision": revision,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end",
    }
    rows.assign(**head).to_csv(out / _TABLE, index=False, float_format="%.6g", lineterminator="\n")
    lines = [*(f"- {name}: {value}" for name, value in head.items()), *(f"- {source}" for source in sources)]
    sections = [_HEADER, "\n".join(lines)]
    late = rows["method"].str.startswith(f"{LATE}, ")
    methods = rows[~late]
    table = ratios(methods)
    for group in table["group"].unique():
        part = table[table["group"] == group].drop(columns="group")
        here = methods[methods["group"] == group]
        sections += [f"## {group}: {_counts(here)}", markdown(part), "### Scene by scene", markdown(_by_scene(here))]
    lags = lag_ratios(rows)
    if len(lags):
        write_lag_figure(lags, out / _FIGURE)
        sections += ["## Later answers", f"Mean errors of `{LATE}` with `lag_s` over those with none, geometric means."]
        sections += [markdown(lags), "![errors against lag](fusion_lag.png)"]
    text = "\n\n".join(sections) + "\n"
    (out / _PAGE).write_text(text, encoding="utf-8")
    return text


def _counts(rows: pd.DataFrame) -> str:
    cases = rows.drop_duplicates(KEY)
    return f"{cases['scene'].nunique()} scenes, {len(cases)} cases, {cases['walks'].sum()} walks"


def _by_scene(rows: pd.DataFrame) -> pd.DataFrame:
    """Who is ahead in each case, beside the raw regressor and the rule."""
    indexed = rows.set_index([*KEY, "method"])
    listing = []
    for best in ahead(rows).to_dict("records"):
        key = tuple(best[name] for name in KEY)
        row = {"scene": best["scene"], "model": best["model"]}
        row["ahead"] = "none: the regressor alone" if best["ahead"] == RAW else best["ahead"]
        names = [best["ahead"], *[name for name in (RAW, RULE) if name != best["ahead"]]]
        for label, name in zip(("ahead", *names[1:]), names, strict=True):
            figures = indexed.loc[(*key, name)]
            row[f"{label}: mean"] = f"{figures[ERRORS[0]]:.3g} m, {figures[ERRORS[1]]:.3g}°"
        best_row = indexed.loc[(*key, best["ahead"])]
        row["p95"] = f"{best_row['position_p95_m']:.3g} m, {best_row['rotation_p95_deg']:.3g}°"
        listing.append(row)
    return pd.DataFrame(listing).fillna("")


def lag_ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean errors of late answers over those without a lag, a row a group and lag; empty where no lags were run."""
    none = rows[rows["method"] == f"{LATE}, {LAGS_S[0]:g} s late"].set_index(KEY)[ERRORS]
    listing = []
    for lag, name in [*((lag, f"{LATE}, {lag:g} s late") for lag in LAGS_S), (np.inf, LATE)]:
        part = rows[rows["method"] == name].set_index(KEY)[ERRORS]
        if len(part) and len(none):
            means = (part / none.reindex(part.index)).apply(np.log).groupby("group", sort=False).mean().apply(np.exp)
            for group, (position, rotation) in means.iterrows():
                listing.append({"group": group, "lag s": lag, "position": position, "rotation": rotation})
    return pd.DataFrame(listing)


def write_lag_figure(lags: pd.DataFrame, path: Path) -> None:
    """Errors against the lag, a line a group; the whole walk stands at the right."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    ticks = [*LAGS_S, np.inf]
    for ax, quantity in zip(axes, ("position", "rotation"), strict=True):
        for group, part in lags.groupby("group", sort=False):
            ax.plot([ticks.index(lag) for lag in part["lag s"]], part[quantity], marker="o", ms=3, lw=1.2, label=group)
        ax.set_xticks(range(len(ticks)), [*(f"{lag:g}" for lag in LAGS_S), "whole walk"])
        ax.set_xlabel("answered so many seconds later")
        ax.set_ylabel(f"mean {quantity} error / in time")
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_ylim(bottom=0)
    axes[1].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)


def markdown(table: pd.DataFrame) -> str:
    """A table in Markdown; an index with a name is its first column."""
    plain = table.reset_index() if table.index.name else table
    lines = ["| " + " | ".join(map(str, plain.columns)) + " |", "|---" * len(plain.columns) + "|"]
    lines += ["| " + " | ".join(map(_cell, row)) + " |" for row in plain.itertuples(index=False)]
    return "\n".join(lines)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.0f}" if 1000 <= abs(value) < np.inf else f"{value:.3g}"
    return str(value)
