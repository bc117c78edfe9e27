"""The import stage's tables from its sessions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields

import numpy as np
import pandas as pd

from groundwalk.capture_import.capture import GpsFix, Reject, Session, poses_of
from groundwalk.capture_import.media.placing import Placed
from groundwalk.capture_import.sampling import Selection
from groundwalk.capture_import.sessions import duration, path_length
from groundwalk.geometry.gravity import gravity_in_camera
from groundwalk.geometry.poses import Array
from groundwalk.geometry.shutter import turned_side, usual_first_row
from groundwalk.store import UserError
from groundwalk.store.choices import ImageSide, LengthUnit, Rejected, SessionSplit, Split, UpAxis
from groundwalk.store.tables import dataset_frames, pose_frame
from groundwalk.store.text import printable

_DEPTH = ("depth", "depth_sha256", "depth_confidence")
_ORIGIN = ("reference_origin_x", "reference_origin_y", "reference_origin_z")


def frames_table(
    session: Session, used: Selection, places: Sequence[Placed], depths: Sequence[Mapping[str, str]], first_row: str
) -> pd.DataFrame:
    """Rows of `frames`, all but the split; and what the split is made from and checked by: `recording`, its name;
    `stated_split`, what a public data set states; `content_sha256`, of the image as captured without metadata (of a
    video's frame as written). `first_row` is the images' side that the sensor reads out first, or auto."""
    raw = session.recording
    stated = raw.first_row if first_row == "auto" else first_row
    rows = []
    for image, support, place, depth in zip(used.images, used.support, places, depths, strict=True):
        camera, check = image.camera, image.check
        stored = (check.height, check.width) if image.quarters % 2 else (check.width, check.height)
        rows.append(
            {
                "frame_id": session.frame_id(image.number),
                "session_id": session.session_id,
                "recording": raw.recording_id,
                "stated_split": image.split or raw.split,
                "t_ns": image.t_ns,
                "clock": raw.clock,
                **place.columns,
                "content_sha256": check.content_sha256 or place.columns["image_sha256"],
                "width": check.width,
                "height": check.height,
                **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
                "distortion": list(camera.distortion),
                "focal_sd": camera.focal_sd,
                "first_row": ImageSide(turned_side(stated or usual_first_row(*stored), image.quarters)),
                "stated_readout_s": math.nan if raw.readout_s is None else raw.readout_s,
                "tracking": image.tracking,
                "sharpness": check.sharpness,
                "exposure_s": math.nan if image.exposure_s is None else image.exposure_s,
                "support": bool(support),
                **dict.fromkeys(_DEPTH),
                **depth,
            }
        )
    poses = poses_of(used.images)
    gravity = gravity_in_camera(poses) if raw.is_gravity_aligned else np.full((len(poses), 3), np.nan)
    if not session.has_vio:
        poses = np.full_like(poses, np.nan)
    axes = pd.DataFrame(gravity, columns=["gravity_x", "gravity_y", "gravity_z"])
    return pd.concat([pd.DataFrame(rows), pose_frame("vio_cam", poses), axes], axis=1)


def reference_table(session: Session, frames: pd.DataFrame) -> pd.DataFrame:
    """Rows of `reference` for a session's rows of `frames`: none where the poses are the phone's, or there are none."""
    if not session.has_reference:
        frames = frames.iloc[:0]
    keys = frames[["frame_id", "session_id", "t_ns"]].reset_index(drop=True)
    return pd.concat([keys, pose_frame("map_cam", session.poses_at(frames["frame_id"]))], axis=1)


def sessions_table(
    sessions: Sequence[Session],
    frames: Mapping[str, pd.DataFrame],
    origin: Array | None = None,
    *,
    reference_is_metric: bool,
) -> pd.DataFrame:
    """One row a session; `frames` has its rows of the frames table with their splits, `origin` (3,) is what was taken
    off the positions of references. `reference_is_metric`: references without a stated unit are in metres."""
    rows = []
    for session in sessions:
        used, recording = frames[session.session_id], session.recording
        dataset = dataset_frames(used)
        unit = LengthUnit.METRE if reference_is_metric or recording.is_metric else LengthUnit.UNKNOWN
        reference_origin = [math.nan] * 3
        if session.has_reference:
            reference_origin = [0.0] * 3 if origin is None else origin.tolist()
        splits = {SessionSplit.TRAIN if split == Split.VAL else SessionSplit(split) for split in dataset["split"]}
        split = SessionSplit.UNUSED if not splits else splits.pop() if len(splits) == 1 else SessionSplit.MIXED
        rows.append(
            {
                "session_id": session.session_id,
                "recording": recording.recording_id,
                "format": recording.format,
                "device": recording.device,
                "clock": recording.clock,
                "duration_s": duration(session),
                "path_m": path_length(session, reference_is_metric),
                "poses": len(session.frames) if session.has_poses else 0,
                "images": len(session.images),
                "frames": len(dataset),
                "support_frames": len(used) - len(dataset),
                "split": split,
                "pose_source": recording.pose_source,
                "reference_unit": unit if session.has_reference else None,
                **dict(zip(_ORIGIN, reference_origin, strict=True)),
                "up": UpAxis.Y if recording.is_gravity_aligned else UpAxis.UNKNOWN,
                "up_source": recording.up_source,
            }
        )
    return pd.DataFrame(rows)


def rejects_table(sessions: Sequence[Session], left_out: Mapping[str, UserError]) -> pd.DataFrame:
    """Rows of `rejects`, with one for each recording that is left out as a whole; what isn't printable in names is
    escaped."""
    rejects = [(session.session_id, reject) for session in sessions for reject in session.rejects]
    rejects += [(name, Reject(name, None, error.line, Rejected.RECORDING)) for name, error in left_out.items()]
    return pd.DataFrame(
        {
            "session_id": [session_id for session_id, _ in rejects],
            "source": [printable(r.source) for _, r in rejects],
            "t_ns": pd.array([r.t_ns for _, r in rejects], dtype="Int64"),
            "reason": [printable(r.reason) for _, r in rejects],
            "rejected": pd.array([r.rejected for _, r in rejects], dtype=object),
        }
    )


def jumps_table(sessions: Sequence[Session]) -> pd.DataFrame:
    rows = [(s.session_id, j.t_ns, j.dt_s, j.jump_m, j.jump_deg, j.splits) for s in sessions for j in s.jumps]
    return pd.DataFrame(rows, columns=["session_id", "t_ns", "dt_s", "jump_m", "jump_deg", "splits"])


def gps_table(fixes: Mapping[str, Sequence[GpsFix]]) -> pd.DataFrame:
    """Rows of `gps` of the positions that each recording states."""
    rows = [{"recording": recording, **asdict(fix)} for recording, of_one in fixes.items() for fix in of_one]
    return pd.DataFrame(rows, columns=["recording", *(field.name for field in fields(GpsFix))])


def vio_table(session: Session) -> pd.DataFrame:
    """Rows of `vio`: none where the poses aren't the phone's."""
    frames = session.frames if session.has_vio else []
    rows = [(session.session_id, frame.t_ns, frame.tracking) for frame in frames]
    columns = pd.DataFrame(rows, columns=["session_id", "t_ns", "tracking"]).astype({"t_ns": np.int64})
    return pd.concat([columns, pose_frame("vio_cam", poses_of(frames))], axis=1)
