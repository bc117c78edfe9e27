"""Is a recording's +y up, as its format has it? Poses may be relative to the first camera instead, or to another one.

Three things tell. What an accelerometer feels points up on average over a walk. A phone never starts with its camera's
axes exactly along its world's, unless the world is its first camera's. And most edges of rooms and houses run along
three directions at right angles, one of them vertical.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundwalk.capture_import.capture import Session
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.features.lines import LONG_SIDE, MIN_LINES, planes_of_lines
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.rows import evenly
from groundwalk.geometry.vanishing import line_axes
from groundwalk.store.choices import PoseSource, UpSource

_MAX_IMAGES = 24
_MIN_IMAGES = 4
# A hand holds no phone so exactly along the axes of its world: within this by chance once in some million starts, as
# two angles must be so small at once (the heading may be zero by definition). Logs round to less.
_EXACT = 1e-4
# A walk's own accelerations average out within seconds, and odometry and accelerometer agree on the vertical within a
# degree or two. Forces that share no direction are of other axes, or without gravity.
_MIN_FORCES, _MIN_SHARED, _MAX_TILT_DEG = 100, 0.8, 5.0

STATE_GRAVITY = (
    "the map gets a vertical from other recordings or none; export poses in the app's gravity-aligned world, or, where "
    'its +y is up, write frames.jsonl with "gravity_aligned": true'
)


@dataclass(frozen=True)
class GravityCheck:
    """Whether +y is up, what says so, and its figures in words; no words where nothing but the format says so."""

    is_aligned: bool
    source: UpSource
    text: str = ""

    @property
    def line(self) -> str:
        """What is said of it; empty where nothing but the format says so."""
        return f"{'+y is up' if self.is_aligned else 'unknown'}: {self.text}" if self.text else ""


def check_gravity(sessions: Sequence[Session], images: ImageReader) -> GravityCheck:
    """Test the gravity of one recording's poses, by its sessions. Its accelerometer goes before lines in the images,
    these before its start pose, and what the capture itself states before all; a reference isn't tested."""
    recording = sessions[0].recording
    stated = GravityCheck(recording.is_gravity_aligned, recording.up_source)
    if recording.pose_source != PoseSource.VIO:
        return stated
    if not stated.is_aligned:
        return replace(stated, text="the capture says that its +y isn't up")
    by_data = _by_accelerometer(sessions) or _by_lines(max(sessions, key=lambda s: len(s.images)), images)
    if stated.source == UpSource.STATED:
        if by_data is None or by_data.is_aligned:
            return stated
        return replace(stated, text=f"by what the capture states, but {by_data.text}")
    if by_data is not None:
        return by_data
    if starts_along_axes(sessions):
        text = "the first pose lies exactly along the world's axes: poses relative to the first camera"
        return GravityCheck(False, UpSource.START_POSE, text)
    return stated


def with_gravity(sessions: Sequence[Session], check: GravityCheck) -> list[Session]:
    aligned, source = check.is_aligned, check.source
    return [
        replace(session, recording=replace(session.recording, is_gravity_aligned=aligned, up_source=source))
        for session in sessions
    ]


def starts_along_axes(sessions: Sequence[Session]) -> bool:
    """The first pose of odometry turns camera axes exactly into axes of the world, as in relative poses whatever their
    convention. Poses that stay the same up to a jump are no start: odometry hasn't begun."""
    rotations = (session.poses[:, :3, :3] for session in sessions if len(session.frames))
    moving = next((r for r in rotations if np.abs(r - r[0]).max() > _EXACT), None)
    return moving is not None and bool(np.abs(moving[0] - moving[0].round()).max() < _EXACT)


def _by_accelerometer(sessions: Sequence[Session]) -> GravityCheck | None:
    """What the recording's accelerometer says; None where it logged none, or too little."""
    log = sessions[0].recording.accelerations
    t_ns = np.concatenate([session.t_ns for session in sessions])
    if log is None or not len(t_ns):
        return None
    poses = np.concatenate([session.poses for session in sessions])
    during = (log.t_ns >= t_ns[0]) & (log.t_ns <= t_ns[-1])
    nearest = np.searchsorted((t_ns[1:] + t_ns[:-1]) // 2, log.t_ns[during])
    force = np.einsum("mij,mj->mi", poses[nearest, :3, :3], log.force_cam[during])
    mean = force.mean(axis=0) if len(force) >= _MIN_FORCES else np.zeros(3)
    if not np.linalg.norm(mean) > _MIN_SHARED * np.median(np.linalg.norm(force, axis=1)):
        return None
    tilt_deg = float(np.degrees(np.arccos(mean[1] / np.linalg.norm(mean))))
    text = f"the accelerometer's mean over {len(force)} samples is {tilt_deg:.1f}° from +y"
    return GravityCheck(tilt_deg < _MAX_TILT_DEG, UpSource.ACCELEROMETER, text)


def _by_lines(session: Session, reader: ImageReader) -> GravityCheck | None:
    """What lines say of a session's +y; None where they say nothing."""
    if len(session.images) < _MIN_IMAGES:
        return None
    images = [session.images[i] for i in evenly(len(session.images), _MAX_IMAGES)]
    lines = []
    for image, gray in reader.gray(images, LONG_SIDE):
        assert image.vio_T_cam is not None  # a sound image has one
        k, check = image.camera, image.check
        camera = Camera(check.width, check.height, k.fx, k.fy, k.cx, k.cy, k.distortion)
        lines.append(planes_of_lines(gray, camera, image.vio_T_cam[:3, :3]))
    if sum(len(lengths) for _, lengths in lines) < MIN_LINES:
        return None
    normals, lengths = (np.concatenate(part) for part in zip(*lines, strict=True))
    axes = line_axes(normals, lengths)
    if axes.is_up is None:
        return None
    text = (
        f"three directions at right angles, one of them +y, explain {axes.upright:.0%} of {len(lengths)} lines in "
        f"{len(lines)} images; the best others, {np.degrees(axes.tilt):.0f}° off, {axes.tilted:.0%}"
    )
    return GravityCheck(axes.is_up, UpSource.LINES, text)
