"""The figures of an evaluation: errors by subset with coverage, and what a user of one session sees."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from fusion.fuse import Fused
from fusion.methods import METHODS
from fusion.walks import Flags, known
from geometry.metrics import accuracy_shares, relative_error
from geometry.poses import Array

RUN = ["method", "options", "model", "scene"]
_OFFLINE = [name for name, method in METHODS.items() if not method.causal]
SUBSETS = {"rp": ["reliable"], "opt": ["optimised"], "rp+opt": ["reliable", "optimised"]}


def summarise(errors: pd.DataFrame) -> pd.DataFrame:
    """Table fuse.summary from fuse.errors.

    The paper's subsets take the frames by `status`; `all` and `common` take the poses in time. Each row of a method
    has a twin that scores the raw predictions of the same frames.
    """
    rows = []
    for run, group in errors.groupby(RUN, sort=False):
        same_model = errors[(errors["model"] == run[2]) & (errors["scene"] == run[3])]
        for subset, frames, prefix in subsets(group, same_model):
            for scored, columns in (("method", prefix), ("apr", "apr_")):
                rows.append(
                    dict(zip(RUN, run, strict=True))
                    | {"subset": subset, "scored": scored}
                    | figures(*score_columns(frames, columns), len(group))
                )
    return pd.DataFrame(rows)


def subsets(group: pd.DataFrame, same_model: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, str]]:
    """Name, frames and column prefix of each subset of one run's frames."""
    if (group["method"] != "apr").all():
        for name, statuses in SUBSETS.items():
            yield name, group[group["status"].isin(statuses)], ""
    yield "all", group, "live_"
    causal = ~same_model["method"].isin(_OFFLINE)
    missed = same_model.loc[causal & same_model["live_position_m"].isna(), "frame_id"]
    yield "common", group[~group["frame_id"].isin(missed)], "live_"


def score_columns(frames: pd.DataFrame, prefix: str) -> tuple[Array, Array]:
    """Position errors in metres and rotation errors in degrees (N,) of rows of fuse.errors."""
    return frames[f"{prefix}position_m"].to_numpy(float), frames[f"{prefix}rotation_deg"].to_numpy(float)


def figures(position: Array, rotation: Array, total: int) -> dict[str, float | int | None]:
    """The figures of a row of fuse.summary for errors (N,) in metres and degrees, NaN where there is no pose."""
    frames, answered = len(position), int(np.isfinite(position).sum())
    shares = accuracy_shares(position, rotation)
    return {
        "frames": frames,
        "answered": answered,
        "total": total,
        "share_pct": 100 * frames / total,
        "coverage_pct": 100 * answered / frames if frames else None,
        "position_mean_m": _mean(position),
        "position_median_m": _median(position),
        "rotation_mean_deg": _mean(rotation),
        "rotation_median_deg": _median(rotation),
        **{f"{level}_pct": 100 * share if frames else None for level, share in shares.items()},
    }


def _mean(errors: Array) -> float | None:
    answered = errors[np.isfinite(errors)]
    return float(answered.mean()) if len(answered) else None


def _median(errors: Array) -> float | None:
    """The median with missing errors as infinite; None where it is infinite or there are no frames."""
    if not len(errors):
        return None
    median = float(np.median(np.where(np.isfinite(errors), errors, np.inf)))
    return median if np.isfinite(median) else None


def session_figures(fused: Fused) -> dict[str, object]:
    """A row of table fuse.sessions."""
    walk, run = fused.walk, fused.run
    seconds = (walk.t_ns - walk.t_ns[0]) * 1e-9
    there = known(fused.live_map_T_cam)
    jitter_m, jitter_deg = _jitter(fused.live_map_T_cam, walk.vio_T_cam)
    return {
        "method": run.method,
        "options": run.options,
        "model": run.model,
        "scene": walk.scene,
        "session_id": walk.session_id,
        "split": walk.split,
        "frames": len(walk),
        "answered": int(there.sum()),
        "first_fix_s": float(seconds[np.argmax(there)]) if there.any() else None,
        "longest_outage_s": _longest_outage(seconds, there),
        "jitter_m": jitter_m,
        "jitter_deg": jitter_deg,
    }


def _longest_outage(seconds: Array, there: Flags) -> float | None:
    """The longest time from one answered frame to the next, or to the walk's end, with an unanswered frame in it."""
    if not there.any():
        return None
    marks = np.append(np.flatnonzero(there), len(there) - 1)
    outage = (np.diff(marks) > 1) | ~there[marks[1:]]
    return float((np.diff(seconds[marks]) * outage).max())


def _jitter(map_T_cam: Array, vio_T_cam: Array) -> tuple[float | None, float | None]:
    """Mean motion between consecutive answered frames that odometry didn't see: metres and degrees a frame."""
    there = known(map_T_cam) & known(vio_T_cam)
    pairs = there[1:] & there[:-1]
    if not pairs.any():
        return None, None
    filled = [np.where(there[:, None, None], poses, np.eye(4)) for poses in (map_T_cam, vio_T_cam)]
    beyond_m, beyond_deg = relative_error(*filled)
    return float(beyond_m[pairs].mean()), float(beyond_deg[pairs].mean())
