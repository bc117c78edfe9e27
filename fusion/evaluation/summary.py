"""The figures of an evaluation: errors by subset with coverage, and how far they would move with other walks."""

from collections.abc import Iterator
from math import comb
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.walk import Flags
from groundwalk.geometry.poses import Array
from groundwalk.scoring.bootstrap import figures_by_session
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
    for key, frames, prefix, total in _subsets_of_runs(errors):
        for scored, columns in (("method", prefix), ("raw", "raw_")):
            rows.append(key | {"scored": scored} | figures(frames, columns, total))
    return pd.DataFrame(rows)


def _subsets_of_runs(errors: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame, str, int]]:
    """The key columns, frames and column prefix of each subset of each run, and how many frames the run has."""
    for run, group in errors.groupby(RUN, sort=False):
        parts = [("all", group, "live_")]
        if METHODS[str(run[0])].fuses:
            parts[:0] = [(name, group[group["status"].isin(statuses)], "") for name, statuses in SUBSETS.items()]
        same_model = errors[(errors["model"] == run[2]) & (errors["scene"] == run[3])]
        causal = same_model[same_model["method"].map({n: METHODS[n].causal for n in same_model["method"].unique()})]
        runs = len(causal[["method", "options"]].drop_duplicates())
        answers = causal.loc[causal["live_position_m"].notna(), "frame_id"].value_counts()
        in_common = answers.reindex(group["frame_id"], fill_value=0).to_numpy() == runs
        for subset, frames, prefix in (*parts, ("common", group[in_common], "live_")):
            yield dict(zip(RUN, run, strict=True)) | {"subset": subset}, frames, prefix, len(group)


def score_columns(frames: pd.DataFrame, prefix: str) -> tuple[Array, Array, Flags]:
    """Position errors in metres, rotation errors in degrees, and whether the ground truth is sure enough for the
    accuracy levels, each (N,), of rows of fuse.errors."""
    position, rotation = (frames[f"{prefix}{name}"].to_numpy(float) for name in ("position_m", "rotation_deg"))
    return position, rotation, sure_enough(frames["quality"])


def figures(frames: pd.DataFrame, prefix: str, total: int) -> dict[str, float | int]:
    """The figures of a row of fuse.summary for rows of fuse.errors, of the errors with that prefix."""
    s = score(*score_columns(frames, prefix))
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


def intervals(errors: pd.DataFrame) -> pd.DataFrame:
    """Table fuse.intervals from fuse.errors: a row a method, model, scene, subset and figure of fuse.summary."""
    rows = []
    for key, frames, prefix, _ in _subsets_of_runs(errors):
        sessions = frames["session_id"].to_numpy(object)
        count = len(set(sessions))
        for figure, value, low, high in figures_by_session(sessions, *score_columns(frames, prefix)):
            drawn = {"sessions": count, "draws": comb(2 * count - 1, count)}
            rows.append(key | {"figure": figure, "value": value, "low": low, "high": high} | drawn)
    return pd.DataFrame(rows)
