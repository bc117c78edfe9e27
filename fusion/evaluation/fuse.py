"""Running localisers over walks, frame by frame as a device would, and measuring what they said."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.fusion.methods import method
from groundwalk.fusion.methods.localiser import Estimate, Stepping, is_rigid
from groundwalk.fusion.methods.offline import Offline, stepped
from groundwalk.fusion.walk import Texts, Walk, known
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store.parallel import one_thread
from groundwalk.store.tables import pose_frame


@dataclass(frozen=True)
class Run:
    """Which method, with which options (JSON), fused which model's predictions."""

    method: str
    options: str
    model: str


@dataclass(frozen=True)
class Fused:
    """What a localiser said about a walk of N frames.

    live_*: in time. status, map_T_cam: with the frames that later ones confirmed. Poses (N, 4, 4) are NaN where none.
    """

    run: Run
    walk: Walk
    estimates: list[Estimate]
    status: Texts
    map_T_cam: Array
    live_status: Texts
    live_map_T_cam: Array

    @property
    def map_T_vio(self) -> Array:
        """The alignments in force, (N, 4, 4), NaN before there is one."""
        return _or_nan([e.map_T_vio for e in self.estimates], (4, 4))

    @property
    def covariance(self) -> Array:
        """Of the errors of the poses in time, (N, 6, 6), NaN where a method states none."""
        return _or_nan([e.covariance for e in self.estimates], (6, 6))


def _or_nan(parts: list[Array | None], shape: tuple[int, int]) -> Array:
    return np.array([np.full(shape, np.nan) if part is None else part for part in parts]).reshape(-1, *shape)


def fuse(run: Run, walk: Walk, localiser: Stepping | Offline) -> Fused:
    """Feed a walk to a fresh localiser, or to one that has been reset, or let an offline method see the whole of it."""
    with one_thread():
        estimates = localiser.estimates(walk) if isinstance(localiser, Offline) else stepped(localiser, walk)
    _check(estimates, walk)
    live_status = np.array([str(e.status) for e in estimates], dtype=object)
    live = _or_nan([e.map_T_cam for e in estimates], (4, 4))
    status, poses = live_status.copy(), live.copy()
    index = {int(t): i for i, t in enumerate(walk.t_ns)}
    for estimate in estimates:
        for t_ns, map_T_cam in estimate.confirms:
            status[index[t_ns]], poses[index[t_ns]] = "reliable", map_T_cam
    return Fused(run, walk, estimates, status, poses, live_status, live)


def _check(estimates: list[Estimate], walk: Walk) -> None:
    """TypeError or ValueError where a method answered something else than an estimate a frame."""
    if len(estimates) != len(walk):
        raise ValueError(f"it gave {len(estimates)} estimates for {len(walk)} frames")
    for number, estimate in enumerate(estimates):
        if not isinstance(estimate, Estimate):
            raise TypeError(f"it gave a {type(estimate).__name__}, not an Estimate, for frame {number}")
        for name, shape in (("map_T_cam", (4, 4)), ("map_T_vio", (4, 4)), ("covariance", (6, 6))):
            part = getattr(estimate, name)
            if part is not None and (np.shape(part) != shape or not np.isfinite(part).all()):
                what = f"shape {np.shape(part)}" if np.shape(part) != shape else "values that aren't finite"
                raise ValueError(f"its {name} for frame {number} has {what}, expected {shape}, or None")
    given = [e.map_T_cam for e in estimates if e.map_T_cam is not None]
    if given and not is_rigid(np.array(given)).all():
        raise ValueError("not all of its map_T_cam are rigid transforms")


def fuse_all(run: Run, walks: Iterable[Walk], make: Callable[[], Stepping | Offline]) -> list[Fused]:
    """Each walk with a localiser of its own: nothing is carried across a session's border. A method that needs odometry
    and map to share their vertical gets none where they may not."""
    needs = method(run.method).needs_vertical
    return [fuse(run, w.without_odometry() if needs and not w.shares_vertical else w, make()) for w in walks]


def pose_rows(fused: Fused) -> pd.DataFrame:
    """Table fuse.poses."""
    covariances = [None if e.covariance is None else e.covariance.ravel().tolist() for e in fused.estimates]
    rows = _keys(fused).assign(
        status=fused.status,
        live_status=fused.live_status,
        covariance=pd.Series(covariances, dtype=object),
        reasons=[",".join(e.reasons) for e in fused.estimates],
    )
    poses = {"map_cam": fused.map_T_cam, "live_map_cam": fused.live_map_T_cam, "map_vio": fused.map_T_vio}
    return pd.concat([rows, *(pose_frame(prefix, a_T_b) for prefix, a_T_b in poses.items())], axis=1)


def error_rows(fused: Fused) -> pd.DataFrame:
    """Table fuse.errors: the frames that have ground truth."""
    walk = fused.walk
    rows = _keys(fused).assign(quality=walk.quality, status=fused.status, live_status=fused.live_status)
    estimates = {"": fused.map_T_cam, "live_": fused.live_map_T_cam, "raw_": walk.map_T_cam_predicted}
    for prefix, map_T_cam in estimates.items():
        rows[f"{prefix}position_m"], rows[f"{prefix}rotation_deg"] = pose_errors(map_T_cam, walk.map_T_cam)
    return rows[known(walk.map_T_cam)].reset_index(drop=True)


def signal_rows(fused: Fused) -> pd.DataFrame:
    """Table fuse.signals: the numbers behind the decisions."""
    signals = [signal for e in fused.estimates for signal in e.signals.items()]
    index = [i for i, e in enumerate(fused.estimates) for _ in e.signals]
    names, values = [name for name, _ in signals], np.array([value for _, value in signals], dtype=float)
    return _keys(fused).iloc[index].reset_index(drop=True).assign(signal=names, value=values)


def stacked(parts: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Tables of one kind below each other."""
    kept = list(parts)
    # Empty parts would blur the column types.
    return pd.concat([p for p in kept if len(p)] or kept[:1], ignore_index=True)


def pose_errors(estimated: Array, true: Array) -> tuple[Array, Array]:
    """APE (N,) and AOE (N,) of poses (N, 4, 4), NaN where either is missing."""
    both = known(estimated) & known(true)
    position_m, rotation_deg = np.full((2, len(true)), np.nan)
    if both.any():
        position_m[both] = position_error(estimated[both], true[both])
        rotation_deg[both] = rotation_error_deg(estimated[both], true[both])
    return position_m, rotation_deg


def _keys(fused: Fused) -> pd.DataFrame:
    of_walk = {name: getattr(fused.walk, name) for name in ("scene", "frame_id", "session_id", "split", "t_ns")}
    return pd.DataFrame(vars(fused.run) | of_walk)
