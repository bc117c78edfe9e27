"""What a user of one session sees: table fuse.sessions."""

import numpy as np

from groundwalk.fusion.evaluation.fuse import Fused, pose_errors
from groundwalk.fusion.walk import Flags, known
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import relative_error

_AWAY_S = 10.0  # without a frame for as long, a phone may have been carried off
_SETTLED_FRAMES = 10


def session_figures(fused: Fused) -> dict[str, object]:
    """A row of table fuse.sessions."""
    walk = fused.walk
    seconds = (walk.t_ns - walk.t_ns[0]) * 1e-9
    there = known(fused.live_map_T_cam)
    jitter_m, jitter_deg = _jitter(fused.live_map_T_cam, walk.vio_T_cam)
    return {
        **vars(fused.run),
        "scene": walk.scene,
        "session_id": walk.session_id,
        "split": walk.split,
        "frames": len(walk),
        "answered": int(there.sum()),
        "first_fix_s": float(seconds[np.argmax(there)]) if there.any() else None,
        "longest_outage_s": _longest_outage(seconds, there),
        "jitter_m": jitter_m,
        "jitter_deg": jitter_deg,
        "recovery_s": _recovery_s(fused, seconds),
    }


def _longest_outage(seconds: Array, there: Flags) -> float | None:
    """The longest time from one answered frame to the next, or to the walk's end, with an unanswered frame in it."""
    if not there.any():
        return None
    marks = np.append(np.flatnonzero(there), len(there) - 1)
    outage = (np.diff(marks) > 1) | ~there[marks[1:]]
    return float((np.diff(seconds[marks]) * outage).max())


def _recovery_s(fused: Fused, seconds: Array) -> float | None:
    """Seconds from the end of the walk's longest time without a frame until ten answers in a row are on average no
    worse than the raw regressor's over the walk: infinite where that never comes, None where there was no such time or
    too few frames with ground truth follow."""
    walk = fused.walk
    true = known(walk.map_T_cam)
    raw_m = pose_errors(walk.map_T_cam_predicted, walk.map_T_cam)[0]
    away = np.diff(seconds)
    if not len(away) or away.max() < _AWAY_S or np.isnan(raw_m).all():
        return None
    back = int(np.argmax(away)) + 1
    after = back + np.flatnonzero(true[back:])
    if len(after) < _SETTLED_FRAMES:
        return None
    errors = pose_errors(fused.live_map_T_cam, walk.map_T_cam)[0][after]
    errors[np.isnan(errors)] = np.inf
    settled = np.convolve(errors, np.full(_SETTLED_FRAMES, 1 / _SETTLED_FRAMES), "valid") <= np.nanmean(raw_m)
    return float(seconds[after[np.argmax(settled)]] - seconds[back]) if settled.any() else np.inf


def _jitter(map_T_cam: Array, vio_T_cam: Array) -> tuple[float | None, float | None]:
    """Mean motion between consecutive answered frames that odometry didn't see: metres and degrees a frame."""
    there = known(map_T_cam) & known(vio_T_cam)
    pairs = there[1:] & there[:-1]
    if not pairs.any():
        return None, None
    filled = [np.where(there[:, None, None], poses, np.eye(4)) for poses in (map_T_cam, vio_T_cam)]
    beyond_m, beyond_deg = relative_error(*filled)
    return float(beyond_m[pairs].mean()), float(beyond_deg[pairs].mean())
