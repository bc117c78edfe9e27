"""From a recording as the phone left it to sessions whose every row can be trusted."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.capture_import.capture import Limits, RawFrame, RawSession, Reject
from groundwalk.capture_import.health import Jump, check_session, find_jumps, size_fault
from groundwalk.capture_import.images import ImageCheck
from groundwalk.capture_import.scan import Look, scan_images
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import Array

Scan = Callable[[list[RawFrame]], Iterable[ImageCheck | str]]


@dataclass(frozen=True)
class Image:
    """A sound image: its row of the log, with a pose, and what it measures."""

    frame: RawFrame
    check: ImageCheck


@dataclass(frozen=True)
class Session:
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
    """What came of one recording."""

    sessions: list[Session]
    rejects: list[Reject]


def take_in(raw: RawSession, settings: ImportSettings, scan: Scan) -> Intake:
    """Check a recording's rows and images, find its jumps, and cut it at the large ones.

    `scan` looks at the images of the given frames (`scan_images`, or a cached result).
    """
    checked = check_session(raw, settings.max_pose_gap_s)
    rejects = list(checked.rejects)
    tracked = []
    for frame in checked.frames:
        if frame.tracking == "lost":
            rejects.append(Reject(raw.session_id, frame.source, frame.t_ns, "not tracking"))
        else:
            tracked.append(frame)
    images, bad = _sound_images(raw.session_id, tracked, settings, scan)
    return Intake(list(_cut_at_jumps(raw, tracked, images, settings)), rejects + bad)


def scan_all(roots: Sequence[Path], limits: Limits) -> Scan:
    """The scan that looks at every image, with links kept inside `roots`."""
    return lambda frames: measures(scan_images(frames, roots, limits))


def measures(looks: Iterable[Look | str]) -> Iterator[ImageCheck | str]:
    """What the images measure, without what they show."""
    return (look.check if isinstance(look, Look) else look for look in looks)


def path_length(session: Session) -> float:
    """Metres that the session's poses walk."""
    return float(np.linalg.norm(np.diff(session.poses[:, :3, 3], axis=0), axis=1).sum())


def _sound_images(
    session_id: str, frames: list[RawFrame], settings: ImportSettings, scan: Scan
) -> tuple[list[Image], list[Reject]]:
    with_image = [f for f in frames if f.image is not None]
    images, rejects = [], []
    for frame, result in zip(with_image, scan(with_image), strict=True):
        assert frame.intrinsics is not None  # health rejects images without
        fault = result if isinstance(result, str) else size_fault(frame.intrinsics, result.width, result.height)
        if fault:
            rejects.append(Reject(session_id, frame.source, frame.t_ns, fault))
        else:
            assert isinstance(result, ImageCheck)
            images.append(Image(frame, result))
    if not images:
        return images, rejects
    usual = float(np.median([i.check.sharpness for i in images]))
    sharp = []
    for image in images:
        if image.check.sharpness < settings.blurred_below * usual:
            reason = f"too blurred: sharpness {image.check.sharpness:.2f}, usual here {usual:.2f}"
            rejects.append(Reject(session_id, image.frame.source, image.frame.t_ns, reason))
        else:
            sharp.append(image)
    return sharp, rejects


def _cut_at_jumps(
    raw: RawSession, frames: list[RawFrame], images: list[Image], settings: ImportSettings
) -> Iterator[Session]:
    whole = Session(raw.session_id, raw, frames, images, [])
    jumps = find_jumps(whole.t_ns, whole.poses) if raw.poses_are == "vio" else []
    large = [j for j in jumps if j.jump_m > settings.split_jump_m or j.jump_deg > settings.split_jump_deg]
    borders = [0, *(j.index for j in large), len(frames)]
    for part, (start, stop) in enumerate(pairwise(borders), start=1):
        numbers = {f.number for f in frames[start:stop]}
        yield Session(
            session_id=raw.session_id if part == 1 else f"{raw.session_id}.part{part}",
            recording=raw,
            frames=frames[start:stop],
            images=[i for i in images if i.frame.number in numbers],
            # A large jump is a row of the session that it ends, so that every session's own poses are without one.
            jumps=[(j, j in large) for j in jumps if start < j.index <= stop and j.index < len(frames)],
        )
