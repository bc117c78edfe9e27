"""The import stage's tables from its sessions."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import get_args

import numpy as np
import pandas as pd

from groundwalk.capture_import.capture import Reject
from groundwalk.capture_import.checks.health import gravity_of
from groundwalk.capture_import.intake import ImportedSession, duration, path_length
from groundwalk.capture_import.media.blurring import Kind
from groundwalk.capture_import.media.depth import PlacedDepth
from groundwalk.capture_import.media.placing import PlacedImage
from groundwalk.capture_import.selection import Selection
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import Appearance, ImageSide, LengthUnit, PoseSource, SessionSplit, Split, UpAxis
from groundwalk.store.tables import dataset_frames, pose_frame


def frames_table(
    session: ImportedSession,
    used: Selection,
    places: Sequence[PlacedImage],
    depths: Sequence[PlacedDepth],
    first_row_of: Callable[[int, int], ImageSide],
) -> pd.DataFrame:
    """Rows of `frames`, all but the split; and what the split is made from and checked by: `recording`, its name;
    `stated_split`, what a public data set states; `content_sha256`, of the image as captured without metadata (of a
    video's frame as written). `first_row_of` takes the size of an image."""
    raw = session.recording
    rows = []
    for image, support, place, depth in zip(used.images, used.support, places, depths, strict=True):
        camera = image.frame.intrinsics
        assert camera is not None  # health rejects images without
        rows.append(
            {
                "frame_id": f"{session.session_id}/{image.frame.number:06d}",
                "session_id": session.session_id,
                "recording": raw.session_id,
                "stated_split": image.frame.split or raw.split,
                "t_ns": image.frame.t_ns,
                "clock": raw.clock,
                "image": place.entry,
                "image_sha256": place.sha256,
                "content_sha256": image.check.content_sha256 or place.sha256,
                "width": image.check.width,
                "height": image.check.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "distortion": list(camera.distortion),
                "first_row": first_row_of(image.check.width, image.check.height),
                "stated_readout_s": math.nan if raw.readout_s is None else raw.readout_s,
                "tracking": image.frame.tracking,
                "sharpness": image.check.sharpness,
                "exposure_s": math.nan if image.frame.exposure_s is None else image.frame.exposure_s,
                "support": bool(support),
                "depth": depth.entry,
                "depth_confidence": depth.confidence,
            }
        )
    blurred = {
        f"blurred_{kind}s": [math.nan if p.blurred is None else float(p.blurred.count(kind)) for p in places]
        for kind in get_args(Kind)
    }
    poses = np.array([image.frame.vio_T_cam for image in used.images], dtype=float).reshape(-1, 4, 4)
    gravity = gravity_of(poses) if raw.is_gravity_aligned else np.full((len(poses), 3), np.nan)
    if raw.pose_source == PoseSource.REFERENCE:
        poses = np.full_like(poses, np.nan)
    return pd.concat(
        [
            pd.DataFrame(rows),
            pd.DataFrame(blurred),
            pose_frame("vio_cam", poses),
            pd.DataFrame(gravity, columns=["gravity_x", "gravity_y", "gravity_z"]),
        ],
        axis=1,
    )


def reference_table(session: ImportedSession, frames: pd.DataFrame) -> pd.DataFrame:
    """Rows of `reference` for a session's rows of `frames`: none where the poses are the phone's."""
    if session.recording.pose_source == PoseSource.VIO:
        frames = frames.iloc[:0]
    pose_of = {f"{session.session_id}/{i.frame.number:06d}": i.frame.vio_T_cam for i in session.images}
    poses = np.array([pose_of[frame_id] for frame_id in frames["frame_id"]], dtype=float).reshape(-1, 4, 4)
    keys = frames[["frame_id", "session_id", "t_ns"]].reset_index(drop=True)
    return pd.concat([keys, pose_frame("map_cam", poses)], axis=1)


def sessions_table(
    sessions: Sequence[ImportedSession],
    frames: Mapping[str, pd.DataFrame],
    appearances: Mapping[str, Appearance],
    origin: Array | None = None,
    *,
    reference_is_metric: bool,
) -> pd.DataFrame:
    """One row a session; `frames` has its rows of the frames table with their splits, `appearances` says what is seen
    in simulated recordings, `origin` (3,) is what was taken off the positions of references. `reference_is_metric`:
    references without a stated unit are in metres."""
    rows = []
    for session in sessions:
        used = frames[session.session_id]
        dataset = dataset_frames(used)
        rows.append(
            {
                "session_id": session.session_id,
                "recording": session.recording.session_id,
                "format": session.recording.format,
                "device": session.recording.device,
                "clock": session.recording.clock,
                "duration_s": duration(session),
                "path_m": path_length(session, reference_is_metric),
                "poses": len(session.frames),
                "images": len(session.images),
                "frames": len(dataset),
                "support_frames": len(used) - len(dataset),
                "split": _session_split(set(dataset["split"])),
                "pose_source": session.recording.pose_source,
                "reference_unit": None
                if session.recording.pose_source == PoseSource.VIO
                else (LengthUnit.METRE if reference_is_metric or session.recording.is_metric else LengthUnit.UNKNOWN),
                **dict(zip(_ORIGIN, _origin_of(session, origin), strict=True)),
                "appearance": appearances.get(session.recording.session_id),
                "up": UpAxis.Y if session.recording.is_gravity_aligned else UpAxis.UNKNOWN,
                "up_source": session.recording.up_source,
            }
        )
    return pd.DataFrame(rows)


_ORIGIN = ("reference_origin_x", "reference_origin_y", "reference_origin_z")


def _origin_of(session: ImportedSession, origin: Array | None) -> list[float]:
    if session.recording.pose_source == PoseSource.VIO:
        return [math.nan] * 3
    return [0.0] * 3 if origin is None else origin.tolist()


def rejects_table(rejects: Sequence[Reject]) -> pd.DataFrame:
    """Rows of `rejects`; names that aren't UTF-8 are shown with their bytes escaped."""
    return pd.DataFrame(
        {
            "session_id": [r.session_id for r in rejects],
            "source": [printable(r.source) for r in rejects],
            "t_ns": pd.array([r.t_ns for r in rejects], dtype="Int64"),
            "reason": [printable(r.reason) for r in rejects],
            "rejected": pd.array([r.rejected for r in rejects], dtype=object),
        }
    )


def jumps_table(sessions: Sequence[ImportedSession]) -> pd.DataFrame:
    """Rows of `jumps`."""
    rows = [(s.session_id, j.t_ns, j.dt_s, j.jump_m, j.jump_deg, splits) for s in sessions for j, splits in s.jumps]
    return pd.DataFrame(rows, columns=["session_id", "t_ns", "dt_s", "jump_m", "jump_deg", "splits"])


def vio_table(session: ImportedSession) -> pd.DataFrame:
    """Rows of `vio`: none where the poses aren't the phone's."""
    frames = session.frames if session.recording.pose_source == PoseSource.VIO else []
    columns = pd.DataFrame(
        {
            "session_id": [session.session_id] * len(frames),
            "t_ns": np.array([f.t_ns for f in frames], dtype=np.int64),
            "tracking": [f.tracking for f in frames],
        }
    )
    poses = session.poses if frames else np.empty((0, 4, 4))
    return pd.concat([columns, pose_frame("vio_cam", poses)], axis=1)


def printable(text: str) -> str:
    """`text` with bytes that aren't UTF-8 escaped."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _session_split(splits: set[str]) -> SessionSplit:
    if not splits:
        return SessionSplit.UNUSED
    if splits <= {Split.TRAIN, Split.VAL}:
        return SessionSplit.TRAIN
    return SessionSplit.TEST if splits == {Split.TEST} else SessionSplit.MIXED
