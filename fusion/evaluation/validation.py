"""Which method is ahead on frames held out of training: what a report leads with is chosen without the test walks."""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.fusion.evaluation.fuse import Run, error_rows, fuse_all, stacked
from groundwalk.fusion.evaluation.summary import figures
from groundwalk.fusion.methods import METHODS, method
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.fusion.walk import Walk
from groundwalk.store.registry import PluginError

ERRORS = ["position_mean_m", "rotation_mean_deg"]


def validation_rows(
    held_out: Iterable[tuple[str, list[Walk]]], options: Mapping[str, MethodOptions], left_out: dict[str, PluginError]
) -> pd.DataFrame:
    """Table fuse.validation: the causal methods on each model's walks of held-out frames, a scene each. Those of other
    packages that fail join what is left out."""
    rows: list[dict[str, Any]] = []
    for model, walks in held_out:
        for name, chosen in options.items():
            if not method(name).causal or name in left_out:
                continue
            try:
                with METHODS.guard(name):
                    fused = fuse_all(Run(name, "", model), walks, partial(method(name).make, chosen))
            except PluginError as fault:
                left_out[name] = fault
                continue
            errors = stacked(error_rows(f) for f in fused)
            of_all = figures(errors, "live_", len(errors))
            row = {"method": name, "model": model, "scene": walks[0].scene}
            rows.append(row | {figure: of_all[figure] for figure in ("frames", "coverage_pct", *ERRORS)})
    rows = [row for row in rows if row["method"] not in left_out]
    if not rows:
        return pd.DataFrame()
    table = pd.DataFrame(rows)
    best = {key: ahead_of(of_case) for key, of_case in table.groupby(["scene", "model"])}
    return table.assign(ahead=[best[row["scene"], row["model"]] == row["method"] for row in rows])


def ahead_of(rows: pd.DataFrame) -> str:
    """The method whose mean errors are least: their geometric mean, over the share of frames answered, as a missing
    pose is a failure. rows: methods that have `method`, the mean errors and `coverage_pct`."""
    size = np.sqrt(rows[ERRORS].astype(float).prod(axis=1, skipna=False)) / (rows["coverage_pct"] / 100)
    return str(rows.loc[size.sort_values(kind="stable").index[0], "method"])
