"""From a recording as the phone wrote it to sessions of sound rows, cut at large VIO jumps."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from groundwalk.capture_import.capture import ImageFile, RawFrame, RawSession, Reject
from groundwalk.capture_import.checks.health import Jump, check_session, content_fault, find_jumps, size_fault
from groundwalk.capture_import.checks.scan import ImageScan
from groundwalk.capture_import.media.images import ImageCheck, exif_orientation
from groundwalk.capture_import.parsing import first_bytes
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import PoseSource, Rejected, SessionSplit, Tracking

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
    if not raw.clock.has_times:
        images, copies = _without_copies(raw, images)
        bad += copies
    sessions = list(_cut_at_jumps(raw, tracked, images, settings))
    return Intake(sessions, _of_parts(rejects + bad, sessions))


def measures(scans: Iterable[ImageScan | str]) -> Iterator[ImageCheck | str]:
    """The scans' checks, without pixels."""
    return (scan.check if isinstance(scan, ImageScan) else scan for scan in scans)


def path_length(session: ImportedSession, reference_is_metric: bool) -> float:
    """Length of the session's path, metres; NaN where the unit of its poses or their order isn't known.
    `reference_is_metric`: references without a stated unit are in metres."""
    if not (session.recording.clock.has_times and (session.recording.is_metric or reference_is_metric)):
        return math.nan
    return float(np.linalg.norm(np.diff(session.poses[:, :3, 3], axis=0), axis=1).sum())


def duration(session: ImportedSession) -> float:
    """Seconds from the first to the last pose; NaN where the recording has no times."""
    if not session.recording.clock.has_times:
        return math.nan
    return float(session.t_ns[-1] - session.t_ns[0]) * 1e-9 if session.frames else 0.0


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
            fault = _by_orientation(frame, result) or fault
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


def _by_orientation(frame: RawFrame, check: ImageCheck) -> str | None:
    """Why width and height are exactly swapped, where EXIF's orientation is why."""
    camera = frame.intrinsics
    if camera is None or check.width == check.height or (camera.height, camera.width) != (check.width, check.height):
        return None
    turn = exif_orientation(first_bytes(frame.image.path)) if isinstance(frame.image, ImageFile) else 1
    if turn < 5:
        return None
    return (
        f"image is stored {check.width}x{check.height}, its intrinsics are for {camera.width}x{camera.height}, as "
        f"viewers show it: EXIF orientation {turn} isn't applied; write the pixels turned (mogrify -auto-orient)"
    )


def _without_copies(raw: RawSession, images: list[Image]) -> tuple[list[Image], list[Reject]]:
    """Of photos that are the same but for metadata, one: for training, where a data set lists it for both sides."""
    first: dict[str, Image] = {}
    for image in sorted(images, key=lambda image: image.frame.split == SessionSplit.TEST):
        first.setdefault(image.check.content_sha256, image)
    copies = [image for image in images if first[image.check.content_sha256] is not image]
    rejects = []
    for copy in copies:
        reason = f"image is a copy of that of {first[copy.check.content_sha256].frame.source}"
        rejects.append(Reject(raw.session_id, copy.frame.source, copy.frame.t_ns, reason, Rejected.IMAGE))
    return [image for image in images if first[image.check.content_sha256] is image], rejects


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
