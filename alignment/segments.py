"""Sessions as the alignment sees them: SfM and VIO poses of the same frames, cut where VIO jumped."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.artefacts.tables import poses_of
from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.geometry.poses import Array

UNTRACKED = ("limited", "lost")


@dataclass(frozen=True)
class Segment:
    """The frames of a session between two VIO jumps, in order of time.

    `rows` (N,) are their positions in the frames table. Poses (N, 4, 4) are NaN where SfM or VIO has none; `up_cam`
    (N, 3) is the unit vector against gravity in camera axes, or NaN. `recording` is the same for all parts of one
    recording, which share the phone's scale and gravity errors. `component` is the SfM model that the poses are from.
    """

    session_id: str
    recording: str
    index: int
    component: int
    rows: np.ndarray
    t_ns: np.ndarray
    sfm_T_cam: Array
    vio_T_cam: Array
    up_cam: Array

    @property
    def registered(self) -> np.ndarray:
        """(N,) SfM has a pose."""
        return np.isfinite(self.sfm_T_cam[:, 0, 0])

    @property
    def tracked(self) -> np.ndarray:
        """(N,) VIO has a pose."""
        return np.isfinite(self.vio_T_cam[:, 0, 0])

    @property
    def both(self) -> np.ndarray:
        """(N,) SfM and VIO have a pose."""
        return self.registered & self.tracked

    @property
    def travelled_m(self) -> Array:
        """(N,) length of the VIO path since the first frame; a frame without VIO stays where the last one was."""
        xyz = pd.DataFrame(self.vio_T_cam[:, :3, 3]).ffill().bfill().to_numpy()
        if np.isnan(xyz).any():
            return np.zeros(len(xyz))
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xyz, axis=0), axis=1))])

    @property
    def trajectory_pair(self) -> TrajectoryPair:
        """The poses of the frames that both know."""
        return TrajectoryPair(self.sfm_T_cam[self.both], self.vio_T_cam[self.both])

    def renumbered(self, row_of: np.ndarray) -> "Segment":
        """The segment with its rows' new positions: row_of (M,) of those in the whole frames table."""
        return replace(self, rows=row_of[self.rows])

    def where(self, wanted: np.ndarray) -> "Segment":
        """The segment's frames for which `wanted` (N,) holds."""
        return Segment(
            self.session_id,
            self.recording,
            self.index,
            self.component,
            self.rows[wanted],
            self.t_ns[wanted],
            self.sfm_T_cam[wanted],
            self.vio_T_cam[wanted],
            self.up_cam[wanted],
        )


def frame_components(frames: pd.DataFrame, images: pd.DataFrame) -> tuple[list[str], np.ndarray]:
    """The models that frames are registered in, largest first, and for each frame (N,) the index of its own.

    `images` are SfM's, in the order of `frames`. A frame that isn't registered counts to the model of the registered
    frame of its session that is nearest in time, or to the first.
    """
    registered = images["registered"].to_numpy(bool)
    counts = images.loc[registered, "model_id"].value_counts()
    names = sorted(counts.index, key=lambda name: (-counts[name], name))
    component = images["model_id"].map({name: i for i, name in enumerate(names)}).fillna(0).to_numpy(int).copy()
    t_ns, session = frames["t_ns"].to_numpy(np.int64), frames["session_id"].to_numpy(str)
    for row in np.flatnonzero(~registered):
        near = np.flatnonzero(registered & (session == session[row]))
        if len(near):
            component[row] = component[near[np.argmin(np.abs(t_ns[near] - t_ns[row]))]]
    return names, component


def cut_segments(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    jumps: pd.DataFrame,
    recordings: dict[str, str],
    component: np.ndarray,
    *,
    jump_m: float,
    jump_deg: float,
) -> list[Segment]:
    """All segments, by session and time; cut at VIO jumps of `jump_m` or `jump_deg` or more, and each of one model.

    `frames` and `jumps` are import's tables, `images` SfM's in the order of `frames`; `recordings` names each session's
    recording, `component` (N,) is `frame_components`'s. A pose that the phone itself calls limited or lost counts as
    none: it may stand still while the phone moves.
    """
    sfm_T_cam = poses_of(images, "sfm_cam")
    sfm_T_cam[~images["registered"].to_numpy(bool)] = np.nan
    vio_T_cam = poses_of(frames, "vio_cam")
    vio_T_cam[frames["tracking"].isin(UNTRACKED).to_numpy()] = np.nan
    up_cam = -frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan)
    t_ns = frames["t_ns"].to_numpy(np.int64)
    session = frames["session_id"].to_numpy(str)
    big = jumps[(jumps["jump_m"] >= jump_m) | (jumps["jump_deg"] >= jump_deg)]

    segments = []
    for session_id in sorted(set(session)):
        rows = np.flatnonzero(session == session_id)
        rows = rows[np.argsort(t_ns[rows], kind="stable")]
        cuts_ns = np.sort(big.loc[big["session_id"] == session_id, "t_ns"].to_numpy(np.int64))
        # side="left": the frame at the jump's time is the first one after it.
        borders = np.searchsorted(t_ns[rows], cuts_ns, side="left")
        parts = [part for part in np.split(rows, borders) if len(part)]
        of_one_model = [(i, c, p[component[p] == c]) for i, p in enumerate(parts) for c in np.unique(component[p])]
        for index, own, part in of_one_model:
            segments.append(
                Segment(
                    session_id,
                    recordings.get(session_id, session_id),
                    index,
                    int(own),
                    part,
                    t_ns[part],
                    sfm_T_cam[part],
                    vio_T_cam[part],
                    up_cam[part],
                )
            )
    return segments
