"""How far an evaluation's figures would move with other walks: table fuse.intervals."""

from math import comb

import numpy as np
import pandas as pd

from groundwalk.fusion.evaluation.summary import RUN, score_columns, subsets
from groundwalk.scoring.bootstrap import drawn_figures, draws, finite, interval


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
