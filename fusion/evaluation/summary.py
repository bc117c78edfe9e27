"""The figures of an evaluation: errors by subset with coverage, and how far they would move with other walks."""

from collections.abc import Iterator
from math import comb

import numpy as np
import pandas as pd

from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.walk import Flags
from groundwalk.geometry.poses import Array
from groundwalk.scoring.bootstrap import drawn_figures, draws, finite, interval
from groundwalk.scoring.errors import sure_enough
from groundwalk.scoring.scores import SUBSETS, score

RUN = ["method", "options", "model", "scene"]


def summarise(errors: pd.DataFrame) -> pd.DataFrame:
    """Table fuse.summary from fuse.errors.

    The paper's subsets take the frames by `status`; `all` and `common` take the poses in time. Each row of a method
    has a twin that scores the raw predictions of the same frames. Levels leave out frames whose ground truth is too
    uncertain for them.
    """
    rows = []
    for run, group in errors.groupby(RUN, sort=False):
        same_model = errors[(errors["model"] == run[2]) & (errors["scene"] == run[3])]
        for subset, frames, prefix in subsets(group, same_model):
            for scored, columns in (("method", prefix), ("raw", "raw_")):
                rows.append(
                    dict(zip(RUN, run, strict=True))
                    | {"subset": subset, "scored": scored}
                    | figures(*score_columns(frames, columns), len(group))
                )
    return pd.DataFrame(rows)


def subsets(group: pd.DataFrame, same_model: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, str]]:
    """Name, frames and column prefix of each subset of one run's frames."""
    if METHODS[group["method"].iloc[0]].fuses:
        for name, statuses in SUBSETS.items():
            yield name, group[group["status"].isin(statuses)], ""
    yield "all", group, "live_"
    causal = same_model[same_model["method"].map({n: METHODS[n].causal for n in same_model["method"].unique()})]
    runs = len(causal[["method", "options"]].drop_duplicates())
    answers = causal.loc[causal["live_position_m"].notna(), "frame_id"].value_counts()
    yield "common", group[answers.reindex(group["frame_id"], fill_value=0).to_numpy() == runs], "live_"


def score_columns(frames: pd.DataFrame, prefix: str) -> tuple[Array, Array, Flags]:
    """Position errors in metres, rotation errors in degrees, and whether the ground truth is sure enough for the
    accuracy levels, each (N,), of rows of fuse.errors."""
    position, rotation = (frames[f"{prefix}{name}"].to_numpy(float) for name in ("position_m", "rotation_deg"))
    return position, rotation, sure_enough(frames["quality"])


def figures(position: Array, rotation: Array, certain: Flags, total: int) -> dict[str, float | int]:
    """The figures of a row of fuse.summary for errors (N,) in metres and degrees, NaN where there is no pose; levels
    are over the `certain` (N,) frames."""
    s = score(position, rotation, certain)
    return {
        "frames": s.frames,
        "answered": s.answered,
        "total": total,
        "frames_pct": 100 * s.frames / total,
        "coverage_pct": 100 * s.answered / s.frames if s.frames else np.nan,
        "too_uncertain": s.frames - s.certain,
        "position_mean_m": s.mean_m,
        "position_median_m": s.median_m,
        "rotation_mean_deg": s.mean_deg,
        "rotation_median_deg": s.median_deg,
        "high_pct": s.high,
        "medium_pct": s.medium,
        "low_pct": s.low,
    }


def intervals(errors: pd.DataFrame, seed: int = 0) -> pd.DataFrame:
    """Table fuse.intervals from fuse.errors: a row a method, model, scene, subset and figure of fuse.summary."""
    rows = []
    for run, group in errors.groupby(RUN, sort=False):
        same_model = errors[(errors["model"] == run[2]) & (errors["scene"] == run[3])]
        for subset, frames, prefix in subsets(group, same_model):
            sessions = frames["session_id"].to_numpy(object)
            names = np.unique(sessions)
            if not len(names):
                continue
            weights = draws(len(names), seed)[:, np.searchsorted(names, sessions)]
            key = dict(zip(RUN, run, strict=True)) | {"subset": subset}
            for figure, values in drawn_figures(*score_columns(frames, prefix), weights):
                low, high = interval(values[1:]) if len(names) > 1 else (None, None)
                rows.append(
                    key
                    | {"figure": figure, "value": finite(values[0]), "low": low, "high": high}
                    | {"sessions": len(names), "draws": comb(2 * len(names) - 1, len(names))}
                )
    return pd.DataFrame(rows)
