"""From a recording as the phone wrote it to sessions of sound rows, cut at large VIO jumps."""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from groundwalk.artefacts.choices import PoseSource, Rejected, Tracking
from groundwalk.capture_import.capture import RawFrame, RawSession, Reject
from groundwalk.capture_import.checks.health import Jump, check_session, content_fault, find_jumps, size_fault
from groundwalk.capture_import.checks.scan import ImageScan
from groundwalk.capture_import.media.images import ImageCheck
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import Array

Scan = Callable[[list[RawFrame]], Iterable[ImageCheck | str]]


@dataclass(frozen=True)
class Image:
    """A sound image: its row of the log, with a pose, its size, sharpness and hash."""

    frame: RawFrame
    check: ImageCheck


@dataclass(frozen=True)
class ImportedSession:
    """A recording, or the part of one between two large jumps of its odometry.

    `frames` are all rows with a sound pose, in time order; `images` those of them with a sound image.
    """

    session_id: str
    recording: RawSession
    frames: list[RawFrame]
    images: list[Image]
    jumps: list[tuple[Jump, bool]]

    @property
    def t_ns(self) -> Any:
        return np.array([f.t_ns for f in self.frames], dtype=np.int64)

    @property
    def poses(self) -> Array:
        return np.array([f.vio_T_cam for f in self.frames], dtype=float).reshape(-1, 4, 4)


@dataclass(frozen=True)
class Intake:
    """The sessions of one recording, and its rejects."""

    sessions: list[ImportedSession]
    rejects: list[Reject]


def take_in(raw: RawSession, settings: ImportSettings, scan: Scan) -> Intake:
    """Check a recording's rows and images, find its jumps, and cut it at the large ones.

    `scan` checks the images of the given frames (`scan_images`, or a cached result).
    """
    checked = check_session(raw, settings.max_pose_gap_s)
    rejects = list(checked.rejects)
    tracked = []
    for frame in checked.frames:
        if frame.tracking == Tracking.LOST:
            rejects.append(Reject(raw.session_id, frame.source, frame.t_ns, "not tracking", frame.content))
        else:
            tracked.append(frame)
    images, bad = _sound_images(raw.session_id, tracked, settings, scan)
    sessions = list(_cut_at_jumps(raw, tracked, images, settings))
    return Intake(sessions, _of_parts(rejects + bad, sessions))


def measures(scans: Iterable[ImageScan | str]) -> Iterator[ImageCheck | str]:
    """The scans' checks, without pixels."""
    return (scan.check if isinstance(scan, ImageScan) else scan for scan in scans)


def path_length(session: ImportedSession) -> float:
    """Length of the session's path, metres."""
    return float(np.linalg.norm(np.diff(session.poses[:, :3, 3], axis=0), axis=1).sum())


def _sound_images(
    session_id: str, frames: list[RawFrame], settings: ImportSettings, scan: Scan
) -> tuple[list[Image], list[Reject]]:
    with_image = [f for f in frames if f.image is not None]
    images, rejects = [], []
    for frame, result in zip(with_image, scan(with_image), strict=True):
        assert frame.intrinsics is not None  # health rejects images without
        if isinstance(result, str):
            fault: str | None = result
        else:
            fault = size_fault(frame.intrinsics, result.width, result.height) or content_fault(result.contrast)
        if fault:
            rejects.append(Reject(session_id, frame.source, frame.t_ns, fault, Rejected.IMAGE))
        else:
            assert isinstance(result, ImageCheck)
            images.append(Image(frame, result))
    if not images:
        return images, rejects
    median = float(np.median([i.check.sharpness for i in images]))
    sharp = []
    for image in images:
        if image.check.sharpness < settings.min_relative_sharpness * median:
            reason = f"too blurred: sharpness {image.check.sharpness:.2f}, median of the session {median:.2f}"
            rejects.append(Reject(session_id, image.frame.source, image.frame.t_ns, reason, Rejected.IMAGE))
        else:
            sharp.append(image)
    return sharp, rejects


def _of_parts(rejects: list[Reject], sessions: list[ImportedSession]) -> list[Reject]:
    """The rejects of a recording, each of the part of it that it lies in by its time; of the first without one."""
    starts = [session.frames[0].t_ns for session in sessions[1:]]
    return [
        replace(reject, session_id=sessions[0 if reject.t_ns is None else bisect_right(starts, reject.t_ns)].session_id)
        for reject in rejects
    ]


def _cut_at_jumps(
    raw: RawSession, frames: list[RawFrame], images: list[Image], settings: ImportSettings
) -> Iterator[ImportedSession]:
    whole = ImportedSession(raw.session_id, raw, frames, images, [])
    jumps = find_jumps(whole.t_ns, whole.poses) if raw.pose_source == PoseSource.VIO else []
    large = [j for j in jumps if j.jump_m > settings.max_jump_m or j.jump_deg > settings.max_jump_deg]
    borders = [0, *(j.index for j in large), len(frames)]
    for part, (start, stop) in enumerate(pairwise(borders), start=1):
        numbers = {f.number for f in frames[start:stop]}
        yield ImportedSession(
            session_id=raw.session_id if part == 1 else f"{raw.session_id}.part{part}",
            recording=raw,
            frames=frames[start:stop],
            images=[i for i in images if i.frame.number in numbers],
            # A large jump is a row of the session that it ends, so that no session's poses have one inside.
            jumps=[(j, j in large) for j in jumps if start < j.index <= stop and j.index < len(frames)],
        )
