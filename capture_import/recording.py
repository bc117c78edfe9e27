"""The import stage's recording: one entity tree a session, each in its own VIO frame."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Session
from groundwalk.geometry.poses import Array, transform
from groundwalk.geometry.rows import evenly
from groundwalk.store.choices import Tracking
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.store.recording import TIMELINE, UP_AXIS, log_images, set_time
from groundwalk.store.tables import dataset_frames
from groundwalk.store.text import printable

_TRACKING_COLOURS = {Tracking.NORMAL: VIO, Tracking.UNKNOWN: VIO, Tracking.LIMITED: REJECTED, Tracking.LOST: NEUTRAL}
# Enough to see each place; more would make the recording of a long walk slow to open.
_MAX_FRUSTA = 150
# The timeline of images without times.
_BY_NAME = "image_by_name"


def blueprint(session_ids: Sequence[str]) -> rrb.Blueprint:
    """A tab a session: its path and cameras, the image at the time cursor, speed and sharpness, rejects."""
    tabs = [
        rrb.Horizontal(
            rrb.Spatial3DView(origin=f"/{session_id}", name="path and cameras"),
            rrb.Vertical(
                rrb.Spatial2DView(origin=f"images/{session_id}", name="image"),
                rrb.TimeSeriesView(origin=f"/{session_id}/speed", name="speed, m/s"),
                rrb.TimeSeriesView(origin=f"/{session_id}/sharpness", name="sharpness"),
                rrb.TextLogView(origin=f"/{session_id}/log", name="rejects and jumps"),
                row_shares=[3, 1.5, 1.5, 1.5],
            ),
            column_shares=[3, 2],
            name=session_id,
        )
        for session_id in session_ids
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, name="sessions"),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def log_session(
    stream: rr.RecordingStream, session: Session, frames: pd.DataFrame, image_path: Callable[[str], Path]
) -> None:
    """Log one session; `frames` are its rows of the frames table. Time counts from the session's first pose; images
    without times are numbered in the order of their names."""
    at, t_ns, positions = f"/{session.session_id}", session.t_ns, session.poses[:, :3, 3]
    stream.log(at, UP_AXIS, static=True)
    if not len(t_ns):
        return
    support, frames = frames[frames["support"]], dataset_frames(frames)
    has_times = session.recording.clock.has_times
    since_ns = frames["t_ns"].to_numpy() - t_ns[0]
    line = (TIMELINE, since_ns) if has_times else (_BY_NAME, since_ns // 10**9)
    log_images(stream, f"images/{at[1:]}", frames.assign(file=frames["image"].map(image_path)), [line])
    _log_curve(stream, f"{at}/sharpness", *line, frames["sharpness"].to_numpy(), NEUTRAL)
    if not session.has_poses:
        return
    colour = VIO if session.has_vio else GROUND_TRUTH
    if has_times:
        speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / (np.diff(t_ns) * 1e-9)
        _log_curve(stream, f"{at}/speed", TIMELINE, t_ns[1:] - t_ns[0], speed, colour)

    # A strip for each part of the same tracking state, to the first pose of the next one, so that the path has no gaps.
    states = np.array([f.tracking for f in session.frames])
    borders = [0, *(np.flatnonzero(states[1:] != states[:-1]) + 1), len(states)]
    strips = [positions[a : b + 1] for a, b in pairwise(borders)]
    colours = [_TRACKING_COLOURS[states[a]] if session.has_vio else colour for a in borders[:-1]]
    path = rr.LineStrips3D(strips, colors=colours, radii=rr.Radius.ui_points(1.5))
    stream.log(f"{at}/{session.recording.pose_source}", path, static=True)
    _log_marks(stream, at, session)
    size_m = float(np.clip(np.ptp(positions, axis=0).max() / 15, 0.05, 1.5))
    for name, rows, depth_m in (("frames", frames, size_m / 4), ("support_frames", support, size_m / 8)):
        _log_frusta(stream, f"{at}/{name}", session, rows.iloc[evenly(len(rows), _MAX_FRUSTA)], depth_m)


def _log_curve(
    stream: rr.RecordingStream,
    at: str,
    timeline: str,
    values_at: NDArray[np.int64],
    values: Array,
    colour: tuple[int, int, int],
) -> None:
    if not len(values):
        return
    stream.log(at, rr.SeriesLines(names=at.rpartition("/")[2], colors=colour), static=True)
    if timeline == TIMELINE:
        times = rr.TimeColumn(timeline, duration=values_at.astype("timedelta64[ns]"))
    else:
        times = rr.TimeColumn(timeline, sequence=values_at)
    stream.send_columns(at, indexes=[times], columns=rr.Scalars.columns(scalars=values))


def _log_frusta(stream: rr.RecordingStream, at: str, session: Session, frames: pd.DataFrame, depth_m: float) -> None:
    """The frames' cameras as wire frames, each labelled with the frame's number."""
    if frames.empty:
        return
    cameras = session.poses_at(frames["frame_id"])
    k = frames[["fx", "fy", "cx", "cy"]].to_numpy()[:, None]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * frames[["width", "height"]].to_numpy()[:, None]
    rays = np.concatenate([(corners - k[..., 2:]) / k[..., :2], np.ones((len(frames), 4, 1))], axis=-1) * depth_m
    with_centre = np.concatenate([rays, np.zeros((len(frames), 1, 3))], axis=1)
    strips = list(transform(cameras[:, None], with_centre)[:, [0, 1, 2, 3, 0, 4, 1, 4, 2, 4, 3]])
    labels, radii = [frame_id[-6:] for frame_id in frames["frame_id"]], rr.Radius.ui_points(0.7)
    outlines = rr.LineStrips3D(strips, colors=NEUTRAL, radii=radii, labels=labels, show_labels=False)
    stream.log(at, outlines, static=True)


def _log_marks(stream: rr.RecordingStream, at: str, session: Session) -> None:
    """Rejects and jumps: a point where the phone was, and a line in the log."""
    t_ns, positions, start = session.t_ns, session.poses[:, :3, 3], int(session.t_ns[0])
    places, labels = [], []
    for reject in session.rejects:
        t = start if reject.t_ns is None else reject.t_ns
        if session.recording.clock.has_times:
            set_time(stream, t - start)
        else:
            stream.set_time(_BY_NAME, sequence=(t - start) // 10**9)
        reason = printable(reject.reason)
        stream.log(f"{at}/log/rejects", rr.TextLog(f"{printable(reject.source)}: {reason}", level="WARN"))
        if reject.t_ns is not None and t_ns[0] <= t <= t_ns[-1]:
            places.append(positions[np.searchsorted(t_ns, t)])
            labels.append(reason)
    if places:
        points = rr.Points3D(places, colors=REJECTED, radii=rr.Radius.ui_points(5), labels=labels, show_labels=False)
        stream.log(f"{at}/rejects", points, static=True)
    if session.jumps:
        ends = np.searchsorted(t_ns, [jump.t_ns for jump in session.jumps]).clip(max=len(t_ns) - 1)
        texts = [f"jump {j.jump_m:.2f} m, {j.jump_deg:.1f} deg" for j in session.jumps]
        points = rr.Points3D(positions[ends], colors=REJECTED, radii=rr.Radius.ui_points(6), labels=texts)
        stream.log(f"{at}/jumps", points, static=True)
        for jump, text in zip(session.jumps, texts, strict=True):
            set_time(stream, jump.t_ns - start)
            stream.log(f"{at}/log/jumps", rr.TextLog(text + ", session split" * jump.splits, level="WARN"))
