"""Does a depth sensor agree with the map, in scale and over distance?"""

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.depth import HIGH_CONFIDENCE, MAX_RANGE_M
from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import CheckName, FailureCause

# Phones' depth sensors are off by some per cent: more says that map or sensor is wrong.
_MAX_SCALE_ERROR, _MAX_SPREAD = 0.05, 0.05
# Fewer samples or frames decide nothing.
_MIN_SAMPLES, _MIN_FRAMES = 100, 3


def check_depth(agreement: pd.DataFrame) -> tuple[list[CheckResult], list[str]]:
    """Checks of each session's scale and geometry by its depth (the align.depth_agreement table), and lines for the
    user. A failure excludes no frame: map or sensor may be what is wrong."""
    results, lines = list[CheckResult](), []
    sessions = agreement[["session_id", "component"]].drop_duplicates()
    for session_id, component in sessions.itertuples(index=False, name=None):
        of_session = agreement[(agreement["session_id"] == session_id) & (agreement["component"] == component)]
        # High confidence where the phone states any.
        confidence, has_levels = of_session["confidence"], of_session["confidence"].notna().any()
        rows = of_session[confidence == HIGH_CONFIDENCE if has_levels else confidence.isna()]
        rows = rows[(rows["samples"] >= _MIN_SAMPLES) & (rows["frames"] >= _MIN_FRAMES)]
        is_whole = (rows["near_m"] == 0.0) & (rows["far_m"] == MAX_RANGE_M)
        if not is_whole.any():
            reason = f"too little depth within {MAX_RANGE_M:g} m to check the map by"
            lines.append(f"{session_id}: {reason}")
            subject, open_ = Subject(int(of_session["frames"].max()), session_id, int(component)), Status.UNDECIDED
            name, limit = CheckName.SESSION_DEPTH_SCALE, _MAX_SCALE_ERROR
            results.append(evaluate(name, subject, Quantity(), limit, _failure(reason), open_))
            continue
        whole, bins = rows[is_whole].iloc[0], rows[~is_whole & (rows["far_m"] <= MAX_RANGE_M)]
        subject = Subject(int(whole["frames"]), session_id, int(component))
        error, sd = float(whole["median_ratio"]) - 1, float(whole["median_ratio_se"])
        reason = (
            f"the sensor's depth is {abs(error):.2%} {'more' if error > 0 else 'less'} than the map's "
            f"(± {sd:.2%}, {whole['samples']} points in {whole['frames']} frames)"
        )
        lines.append(f"{session_id}: {reason}")
        estimate = Quantity(abs(error), sd)
        results.append(evaluate(CheckName.SESSION_DEPTH_SCALE, subject, estimate, _MAX_SCALE_ERROR, _failure(reason)))
        if len(bins) > 1:
            # The largest difference between the ratios of two distances.
            ordered = bins.sort_values("median_ratio")
            low, high = ordered.iloc[0], ordered.iloc[-1]
            sd = float(np.hypot(low["median_ratio_se"], high["median_ratio_se"]))
            estimate = Quantity(float(high["median_ratio"] - low["median_ratio"]), sd)
            failure = _failure(
                f"depth by the sensor over depth by the map differs with distance: {low['median_ratio']:.3f} from "
                f"{low['near_m']:g} m, {high['median_ratio']:.3f} from {high['near_m']:g} m"
            )
            results.append(evaluate(CheckName.SESSION_DEPTH_BY_DISTANCE, subject, estimate, _MAX_SPREAD, failure))
    return results, lines


def _failure(reason: str) -> Failure:
    return Failure(cause=FailureCause.DEPTH_INCONSISTENT, reason=reason)
