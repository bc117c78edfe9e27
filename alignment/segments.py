"""Segments of sessions: SfM and VIO poses of the same frames, cut where VIO jumped."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.consistency.windows import WindowResiduals
from groundwalk.geometry.poses import Array, path_length
from groundwalk.store.choices import UNTRACKED
from groundwalk.store.tables import poses_of


@dataclass(frozen=True, kw_only=True)
class Segment:
    """The frames of a session in one SfM model between two VIO jumps, in order of time.

    `rows` (N,) are their positions in the frames table. Poses (N, 4, 4) are NaN where SfM or VIO has none; `up_cam`
    (N, 3) is the unit vector against gravity in camera axes, or NaN. `recording` is the same for all sessions of one
    recording, which share the phone's scale and gravity errors. `component` is the SfM model that the poses are from.
    `travelled_m` (N,) is the length of VIO's path since the session's first frame, in which all its frames count; a
    frame without VIO stays where the last one was.
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
    travelled_m: Array

    @property
    def registered(self) -> np.ndarray:
        """(N,) SfM has a pose."""
        return np.isfinite(self.sfm_T_cam[:, 0, 0])

    @property
    def has_vio(self) -> np.ndarray:
        """(N,) VIO has a pose."""
        return np.isfinite(self.vio_T_cam[:, 0, 0])

    @property
    def has_both(self) -> np.ndarray:
        """(N,) SfM and VIO have a pose."""
        return self.registered & self.has_vio

    @property
    def has_gravity(self) -> bool:
        """VIO's +y is up."""
        return bool(np.isfinite(self.up_cam).all(axis=1).any())

    @property
    def path_m(self) -> float:
        """Length of VIO's path from the first frame to the last."""
        return float(self.travelled_m[-1] - self.travelled_m[0])

    @property
    def trajectory_pair(self) -> TrajectoryPair:
        """The poses of the frames that both SfM and VIO have."""
        both = self.has_both
        return TrajectoryPair(self.sfm_T_cam[both], self.vio_T_cam[both], self.travelled_m[both])

    def where(self, mask: np.ndarray) -> "Segment":
        """The segment's frames for which `mask` (N,) holds."""
        arrays = ("rows", "t_ns", "sfm_T_cam", "vio_T_cam", "up_cam", "travelled_m")
        return replace(self, **{name: getattr(self, name)[mask] for name in arrays})


@dataclass(frozen=True)
class SegmentWindow(WindowResiduals):
    """A window of a segment: `inside` (n,) are indices of its frames."""

    segment: Segment


def registered_rows(segments: Sequence[Segment], session_id: str | None = None) -> np.ndarray:
    """Rows of the frames table that SfM has a pose for, of all sessions or of one."""
    chosen = [s.rows[s.registered] for s in segments if session_id in (None, s.session_id)]
    return np.concatenate([np.empty(0, np.intp), *chosen])


def sessions_of(segments: Sequence[Segment]) -> list[str]:
    """The sessions of segments, each once, in their order."""
    return list(dict.fromkeys(s.session_id for s in segments))


def cut_segments(
    frames: pd.DataFrame, images: pd.DataFrame, jumps: pd.DataFrame, recordings: dict[str, str], numbers: dict[str, int]
) -> tuple[list[str], list[Segment]]:
    """SfM's models that frames are registered in, those with `numbers` in their order, then the largest first, and all
    segments, by session and time; cut at VIO jumps, and each of one model.

    `frames` and `jumps` are import's tables, `images` SfM's in the order of `frames`; `recordings` names each session's
    recording. A pose of limited or lost tracking counts as none.
    """
    names, component = _frame_components(frames, images, numbers)
    sfm_T_cam = poses_of(images, "sfm_cam")
    sfm_T_cam[~images["registered"].to_numpy(bool)] = np.nan
    vio_T_cam = poses_of(frames, "vio_cam")
    vio_T_cam[frames["tracking"].isin(UNTRACKED).to_numpy()] = np.nan
    up_cam = -frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan)
    t_ns, session = frames["t_ns"].to_numpy(np.int64), frames["session_id"].to_numpy(str)
    segments, travelled_m = [], np.zeros(len(frames))
    every = {"t_ns": t_ns, "sfm_T_cam": sfm_T_cam, "vio_T_cam": vio_T_cam, "up_cam": up_cam, "travelled_m": travelled_m}
    for session_id in sorted(set(session)):
        rows, recording = np.flatnonzero(session == session_id), recordings.get(session_id, session_id)
        rows = rows[np.argsort(t_ns[rows], kind="stable")]
        placed = pd.DataFrame(vio_T_cam[rows, :3, 3]).ffill().bfill().to_numpy()
        travelled_m[rows] = 0.0 if np.isnan(placed).any() else path_length(placed)
        # The frame at the jump's time is the first one after it.
        jumps_ns = np.sort(jumps.loc[jumps["session_id"] == session_id, "t_ns"].to_numpy(np.int64))
        between_jumps = [r for r in np.split(rows, np.searchsorted(t_ns[rows], jumps_ns)) if len(r)]
        for index, between in enumerate(between_jumps):
            for number in np.unique(component[between]):
                of_model = between[component[between] == number]
                of_rows = {name: values[of_model] for name, values in every.items()}
                whose = {"session_id": session_id, "recording": recording}
                segments.append(Segment(**whose, index=index, component=int(number), rows=of_model, **of_rows))
    return names, segments


def _frame_components(
    frames: pd.DataFrame, images: pd.DataFrame, numbers: dict[str, int]
) -> tuple[list[str], np.ndarray]:
    """The models that frames are registered in, ordered as by `cut_segments`, and each frame's (N,) index of its model.

    `images` are SfM's, in the order of `frames`. A frame that isn't registered counts to the model of the registered
    frame of its session that is nearest in time, or to the first.
    """
    registered = images["registered"].to_numpy(bool)
    counts = images.loc[registered, "model_id"].value_counts()
    names = sorted(counts.index, key=lambda name: (numbers.get(name, np.inf), -counts[name], name))
    component = images["model_id"].map({name: i for i, name in enumerate(names)}).fillna(0).to_numpy(int).copy()
    t_ns, session = frames["t_ns"].to_numpy(np.int64), frames["session_id"].to_numpy(str)
    for row in np.flatnonzero(~registered):
        near = np.flatnonzero(registered & (session == session[row]))
        if len(near):
            component[row] = component[near[np.argmin(np.abs(t_ns[near] - t_ns[row]))]]
    return names, component
