"""From a recording as the phone wrote it to sessions of sound rows, cut at large VIO jumps, or by camera."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from groundwalk.capture_import.capture import (
    Image,
    ImageCheck,
    ImageFile,
    RawFrame,
    Recording,
    Reject,
    Session,
    poses_of,
)
from groundwalk.capture_import.checks.jumps import find_jumps
from groundwalk.capture_import.checks.rows import check_rows, content_fault, size_fault
from groundwalk.capture_import.media.images import exif_orientation
from groundwalk.store.choices import PoseSource, SessionSplit


def sound_sessions(
    recording: Recording,
    check_images: Callable[[list[RawFrame]], Iterable[ImageCheck | str]],
    min_relative_sharpness: float,
) -> list[Session]:
    """Check a recording's rows and images, find its jumps, and cut it at the large ones: one session at least. Where
    it has no poses, each of its cameras has a session.

    `check_images` gives for each of the given frames what was measured of its image, or why it can't be used. One less
    sharp than `min_relative_sharpness` of the median is rejected.
    """
    frames, rejects = check_rows(recording)
    images, bad = _sound_images([f for f in frames if f.image is not None], check_images, min_relative_sharpness)
    if not recording.clock.has_times:
        images, copies = _without_copies(images)
        bad += copies
    if recording.pose_source == PoseSource.NONE:
        return _by_camera(recording, frames, images, [*rejects, *bad])
    poses = poses_of(frames)
    t_ns = np.array([f.t_ns for f in frames], dtype=np.int64)
    jumps = find_jumps(t_ns, poses) if recording.pose_source == PoseSource.VIO else []
    starts = [0, *(jump.index for jump in jumps if jump.splits)]
    # A reject is of the session that it lies in by its time; of the first where it has none.
    lies_in = [0 if r.t_ns is None else bisect_right(t_ns[starts[1:]].tolist(), r.t_ns) for r in (*rejects, *bad)]
    sessions = []
    for place, (start, stop) in enumerate(pairwise([*starts, len(frames)])):
        numbers = {frame.number for frame in frames[start:stop]}
        sessions.append(
            Session(
                session_id=recording.recording_id + (f".part{place + 1}" if place else ""),
                recording=recording,
                frames=frames[start:stop],
                images=[image for image in images if image.frame.number in numbers],
                # A large jump is a row of the session that it ends, so that no session's poses have one inside.
                jumps=[jump for jump in jumps if start < jump.index <= stop],
                rejects=[reject for reject, at in zip((*rejects, *bad), lies_in, strict=True) if at == place],
            )
        )
    return sessions


def _by_camera(
    recording: Recording, frames: list[RawFrame], images: list[Image], rejects: list[Reject]
) -> list[Session]:
    """A session a camera, in order of their first images; rejects are of the first one. What a camera is called in the
    file doesn't leave import."""
    sessions = []
    for place, camera in enumerate(dict.fromkeys([frame.camera for frame in frames] or [""])):
        name = f"camera {place + 1}"
        sessions.append(
            Session(
                session_id=recording.recording_id + (f".camera{place + 1}" if place else ""),
                recording=replace(recording, device=name if recording.device == "unknown" else recording.device),
                frames=[frame for frame in frames if frame.camera == camera],
                images=[image for image in images if image.frame.camera == camera],
                jumps=[],
                rejects=[] if place else rejects,
            )
        )
    return sessions


def path_length(session: Session, reference_is_metric: bool) -> float:
    """Length of the session's path, metres; NaN where the unit of its poses or their order isn't known.
    `reference_is_metric`: references without a stated unit are in metres."""
    if not (session.recording.clock.has_times and (session.recording.is_metric or reference_is_metric)):
        return math.nan
    return float(np.linalg.norm(np.diff(session.poses[:, :3, 3], axis=0), axis=1).sum())


def duration(session: Session) -> float:
    """Seconds from the first to the last pose; NaN where the recording has no times."""
    if not session.recording.clock.has_times:
        return math.nan
    return float(session.t_ns[-1] - session.t_ns[0]) * 1e-9 if session.frames else 0.0


def _sound_images(
    frames: list[RawFrame],
    check_images: Callable[[list[RawFrame]], Iterable[ImageCheck | str]],
    min_relative_sharpness: float,
) -> tuple[list[Image], list[Reject]]:
    images, rejects = [], []
    for frame, result in zip(frames, check_images(frames), strict=True):
        fault = result if isinstance(result, str) else _image_fault(frame, result)
        if fault is not None:
            rejects.append(Reject.of(frame, fault))
        elif isinstance(result, ImageCheck):
            images.append(Image(frame, result))
    median = float(np.median([image.check.sharpness for image in images])) if images else 0.0
    sharp = [image for image in images if image.check.sharpness >= min_relative_sharpness * median]
    rejects += [
        Reject.of(i.frame, f"too blurred: sharpness {i.check.sharpness:.2f}, median of the session {median:.2f}")
        for i in images
        if i.check.sharpness < min_relative_sharpness * median
    ]
    return sharp, rejects


def _image_fault(frame: RawFrame, check: ImageCheck) -> str | None:
    """What is wrong with an image that could be decoded, under its intrinsics."""
    camera = frame.intrinsics
    assert camera is not None  # check_rows rejects images without
    is_swapped = check.width != check.height and (camera.height, camera.width) == (check.width, check.height)
    if is_swapped and isinstance(frame.image, ImageFile) and (turn := exif_orientation(frame.image.path)) >= 5:
        return (
            f"image is stored {check.width}x{check.height}, its intrinsics are for {camera.width}x{camera.height}, as "
            f"viewers show it: EXIF orientation {turn} isn't applied; write the pixels turned (mogrify -auto-orient)"
        )
    return size_fault(camera, check.width, check.height) or content_fault(check.contrast)


def _without_copies(images: list[Image]) -> tuple[list[Image], list[Reject]]:
    """Of photos that are the same but for metadata, one: for training, where a data set lists it for both sides."""
    first: dict[str, Image] = {}
    for image in sorted(images, key=lambda image: image.frame.split == SessionSplit.TEST):
        first.setdefault(image.check.content_sha256, image)
    kept, rejects = [], []
    for image in images:
        original = first[image.check.content_sha256]
        if original is image:
            kept.append(image)
        else:
            rejects.append(Reject.of(image.frame, f"image is a copy of that of {original.frame.source}"))
    return kept, rejects
