"""A reference's origin near its cameras: georeferenced ones (ECEF, UTM) are thousands of kilometres from theirs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groundwalk.capture_import.capture import RawFrame, Session
from groundwalk.geometry.poses import Array, make_pose

# What reads positions as float32 (recordings, networks, other tools) sees steps of 6e-8 of their distance from the
# origin: of 6e-5 of the extent where that is so many times as far.
_MAX_DISTANCE_EXTENTS = 1e3


def far_origin(sessions: Sequence[Session]) -> Array | None:
    """The origin (3,) to take off the positions of all references, in their unit and axes; None where these are near
    enough to theirs. Round to a power of ten of about the extent."""
    positions = [s.poses[:, :3, 3] for s in sessions if s.frames and s.has_poses and not s.has_vio]
    if not positions:
        return None
    xyz = np.concatenate(positions)
    extent, middle = float(np.linalg.norm(np.ptp(xyz, axis=0))), np.median(xyz, axis=0)
    if not 0 < _MAX_DISTANCE_EXTENTS * extent < np.linalg.norm(middle):
        return None
    step = 10.0 ** np.ceil(np.log10(extent))
    return step * np.round(middle / step)


def moved(session: Session, origin: Array) -> Session:
    """The session with poses from another origin, where they are a reference."""
    if session.has_vio or not session.has_poses:
        return session

    def of(frame: RawFrame) -> RawFrame:
        pose = frame.vio_T_cam
        assert pose is not None  # a session has no rows without
        return replace(frame, vio_T_cam=make_pose(pose[:3, :3], pose[:3, 3] - origin))

    return replace(session, frames=[of(frame) for frame in session.frames])


def describe_origin(origin: Array) -> str:
    """A line for the user on an origin that was taken off."""
    return (
        "reference poses are far from their origin, as georeferenced ones are: the map's origin is at "
        f"({', '.join(f'{value:.12g}' for value in origin)}) of the data set's own coordinates, which sessions.parquet "
        "keeps (reference_origin_x, _y, _z)"
    )
