"""Which method is ahead on frames held out of training: what a report leads with is chosen without the test walks."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.fusion.evaluation.fuse import Run, error_rows, fuse_all, stacked
from groundwalk.fusion.evaluation.summary import figures
from groundwalk.fusion.methods import method
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.fusion.walk import Walk

ERRORS = ["position_mean_m", "rotation_mean_deg"]


def validation_rows(walks: list[Walk], model: str, options: Mapping[str, MethodOptions]) -> pd.DataFrame:
    """Rows of table fuse.validation of one scene and model: each causal method on held-out frames' walks."""
    rows: list[dict[str, Any]] = []
    for name, chosen in options.items():
        if not method(name).causal:
            continue
        fused = fuse_all(Run(name, "", model), walks, partial(method(name).make, chosen))
        errors = stacked(error_rows(f) for f in fused)
        of_all = figures(errors, "live_", len(errors))
        row = {"method": name, "model": model, "scene": walks[0].scene}
        rows.append(row | {figure: of_all[figure] for figure in ("frames", "coverage_pct", *ERRORS)})
    table = pd.DataFrame(rows)
    best = ahead_of(table)
    return table.assign(ahead=[name == best for name in table["method"]])


def ahead_of(rows: pd.DataFrame) -> str:
    """The method whose mean errors are least: their geometric mean, over the share of frames answered, as a missing
    pose is a failure. rows: methods that have `method`, the mean errors and `coverage_pct`."""
    size = np.sqrt(rows[ERRORS].astype(float).prod(axis=1, skipna=False)) / (rows["coverage_pct"] / 100)
    return str(rows.loc[size.sort_values(kind="stable").index[0], "method"])
