"""The import stage's recording: one entity tree a session, each in its own VIO frame."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Session
from groundwalk.capture_import.media.images import decode_rgb, encode_jpeg, image_size
from groundwalk.geometry.poses import Array, transform
from groundwalk.geometry.rows import evenly
from groundwalk.store.choices import Tracking
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.store.parallel import in_parallel
from groundwalk.store.recording import TIMELINE, UP_AXIS, set_time
from groundwalk.store.tables import dataset_frames
from groundwalk.store.text import printable

_TRACKING_COLOURS = {
    Tracking.NORMAL: VIO,
    Tracking.UNKNOWN: VIO,
    Tracking.LIMITED: REJECTED,
    Tracking.LOST: NEUTRAL,
}
# Enough to see each place; more would make the recording of a long walk slow to open.
_MAX_FRUSTA = 150
_MAX_THUMBNAILS, _THUMBNAIL_PX, _THUMBNAIL_QUALITY = 300, 320, 70
_BATCH = 64
# The timeline of images without times.
_BY_NAME = "image_by_name"


def blueprint(session_ids: Sequence[str]) -> rrb.Blueprint:
    """A tab a session: its path and cameras, the image at the time cursor, speed and sharpness, rejects."""
    return rrb.Blueprint(
        rrb.Tabs(*[_session_view(session_id) for session_id in session_ids], name="sessions"),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def log_session(
    stream: rr.RecordingStream, session: Session, frames: pd.DataFrame, image_path: Callable[[str], Path]
) -> None:
    """Log one session; `frames` are its rows of the frames table. Time counts from the session's first pose; images
    without times are numbered in the order of their names."""
    at = f"/{session.session_id}"
    poses = session.poses
    stream.log(at, UP_AXIS, static=True)
    if not len(poses):
        return
    if not session.has_poses:
        _log_curves(stream, at, session, dataset_frames(frames))
        _log_images(stream, session, dataset_frames(frames), image_path, 1.0)
        return
    _log_path(stream, f"{at}/{session.recording.pose_source}", session)
    support, frames = frames[frames["support"]], dataset_frames(frames)
    _log_curves(stream, at, session, frames)
    _log_marks(stream, at, session)
    size = float(np.clip(np.ptp(poses[:, :3, 3], axis=0).max() / 15, 0.05, 1.5))
    for name, rows, depth_m in (("frames", frames, size / 4), ("support_frames", support, size / 8)):
        outlined = rows.iloc[evenly(len(rows), _MAX_FRUSTA)]
        _log_frusta(stream, f"{at}/{name}", outlined, _cameras(session, outlined), depth_m)
    _log_images(stream, session, frames, image_path, size)


def _log_images(
    stream: rr.RecordingStream,
    session: Session,
    frames: pd.DataFrame,
    image_path: Callable[[str], Path],
    size_m: float,
) -> None:
    """The moving camera with some of the frames' images, small; where there are no poses, it stays at the origin."""

    def small(image: str) -> bytes:
        return encode_jpeg(decode_rgb(image_path(image).read_bytes(), _THUMBNAIL_PX), _THUMBNAIL_QUALITY)

    at = f"/{session.session_id}/camera"
    shown = frames.iloc[:: max(1, math.ceil(len(frames) / _MAX_THUMBNAILS))]
    for first in range(0, len(shown), _BATCH):
        batch = shown.iloc[first : first + _BATCH]
        count, jpegs = len(batch), list(in_parallel(small, batch["image"]))
        times = _time_column(session, batch["t_ns"].to_numpy() - session.t_ns[0])
        cameras = _cameras(session, batch) if session.has_poses else np.tile(np.eye(4), (count, 1, 1))
        sizes = [image_size(jpeg) for jpeg in jpegs]
        k = np.tile(np.eye(3), (count, 1, 1))
        k[:, [0, 1, 0, 1], [0, 1, 2, 2]] = batch[["fx", "fy", "cx", "cy"]].to_numpy()
        k[:, :2] *= (np.array(sizes)[:, 0] / batch["width"].to_numpy())[:, None, None]
        moving = rr.Transform3D.columns(translation=cameras[:, :3, 3], mat3x3=cameras[:, :3, :3])
        stream.send_columns(at, indexes=[times], columns=moving)
        camera = rr.Pinhole.columns(
            image_from_camera=k,
            resolution=sizes,
            camera_xyz=[rr.ViewCoordinates.RDF] * count,
            image_plane_distance=[size_m] * count,
            color=[VIO] * count,
        )
        image = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * count)
        stream.send_columns(f"{at}/image", indexes=[times], columns=[*camera, *image])


def _cameras(session: Session, frames: pd.DataFrame) -> Array:
    """The session's poses (N, 4, 4) of these rows of the frames table."""
    pose_of = {session.frame_id(image.number): image.vio_T_cam for image in session.images}
    return np.array([pose_of[name] for name in frames["frame_id"]], dtype=float).reshape(-1, 4, 4)


def _session_view(session_id: str) -> rrb.Container:
    at = f"/{session_id}"
    return rrb.Horizontal(
        rrb.Spatial3DView(origin=at, name="path and cameras"),
        rrb.Vertical(
            rrb.Spatial2DView(origin=f"{at}/camera/image", name="image"),
            rrb.TimeSeriesView(origin=f"{at}/speed", name="speed, m/s"),
            rrb.TimeSeriesView(origin=f"{at}/sharpness", name="sharpness"),
            rrb.TextLogView(origin=f"{at}/log", name="rejects and jumps"),
            row_shares=[3, 1.5, 1.5, 1.5],
        ),
        column_shares=[3, 2],
        name=session_id,
    )


def _log_frusta(stream: rr.RecordingStream, at: str, frames: pd.DataFrame, cameras: Array, depth_m: float) -> None:
    """The frames' cameras (N, 4, 4) as wire frames, each labelled with the frame's number."""
    if frames.empty:
        return
    k = frames[["fx", "fy", "cx", "cy"]].to_numpy()[:, None]
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * frames[["width", "height"]].to_numpy()[:, None]
    rays = np.concatenate([(corners - k[..., 2:]) / k[..., :2], np.ones((len(frames), 4, 1))], axis=-1) * depth_m
    with_centre = np.concatenate([rays, np.zeros((len(frames), 1, 3))], axis=1)
    strips = list(transform(cameras[:, None], with_centre)[:, [0, 1, 2, 3, 0, 4, 1, 4, 2, 4, 3]])
    labels, radii = [frame_id[-6:] for frame_id in frames["frame_id"]], rr.Radius.ui_points(0.7)
    outlines = rr.LineStrips3D(strips, colors=NEUTRAL, radii=radii, labels=labels, show_labels=False)
    stream.log(at, outlines, static=True)


def _log_path(stream: rr.RecordingStream, at: str, session: Session) -> None:
    """The path, in one strip for each part of the same tracking state; a reference in the colour of ground truth."""
    positions = session.poses[:, :3, 3]
    states = np.array([f.tracking for f in session.frames])
    borders = [0, *(np.flatnonzero(states[1:] != states[:-1]) + 1), len(states)]
    # A strip reaches to the first pose of the next one, so that the path has no gaps.
    strips = [positions[a : b + 1] for a, b in pairwise(borders)]
    colours = [_TRACKING_COLOURS[states[a]] for a in borders[:-1]]
    if not session.has_vio:
        colours = [_colour(session)] * len(strips)
    stream.log(at, rr.LineStrips3D(strips, colors=colours, radii=rr.Radius.ui_points(1.5)), static=True)


def _log_curves(stream: rr.RecordingStream, at: str, session: Session, frames: pd.DataFrame) -> None:
    t_ns, positions = session.t_ns, session.poses[:, :3, 3]
    if len(t_ns) > 1 and session.recording.clock.has_times and session.has_poses:
        speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / (np.diff(t_ns) * 1e-9)
        since = _time_column(session, t_ns[1:] - t_ns[0])
        _log_curve(stream, f"{at}/speed", since, speed, "speed", _colour(session))
    if len(frames):
        since = _time_column(session, frames["t_ns"].to_numpy() - t_ns[0])
        _log_curve(stream, f"{at}/sharpness", since, frames["sharpness"].to_numpy(), "sharpness", NEUTRAL)


def _time_column(session: Session, since_ns: NDArray[np.int64]) -> rr.TimeColumn:
    if session.recording.clock.has_times:
        return rr.TimeColumn(TIMELINE, duration=since_ns.astype("timedelta64[ns]"))
    return rr.TimeColumn(_BY_NAME, sequence=since_ns // 10**9)


def _colour(session: Session) -> tuple[int, int, int]:
    return VIO if session.has_vio else GROUND_TRUTH


def _log_curve(
    stream: rr.RecordingStream, at: str, times: rr.TimeColumn, values: Array, name: str, colour: tuple[int, int, int]
) -> None:
    stream.log(at, rr.SeriesLines(names=name, colors=colour), static=True)
    stream.send_columns(at, indexes=[times], columns=rr.Scalars.columns(scalars=values))


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
