"""What a capture holds, its health and whether it can be used, for reading on a terminal."""

import math
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path

import numpy as np

from groundwalk.capture_import.capture import Recording, Session
from groundwalk.capture_import.checks.clock import check_clock
from groundwalk.capture_import.checks.convention import (
    MIN_EXPLAINED,
    ConventionCheck,
    check_convention,
    with_focal_length,
)
from groundwalk.capture_import.checks.gravity import check_gravity
from groundwalk.capture_import.checks.plausibility import PlausibilityFault, plausibility_faults
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sampling import select, select_enough
from groundwalk.capture_import.sessions import describe_origin, duration, far_origin, path_length, sound_sessions
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.store import UserError
from groundwalk.store.choices import PoseSource
from groundwalk.store.errors import MachineError
from groundwalk.store.progress import track
from groundwalk.store.registry import PluginError
from groundwalk.store.text import grouped_reasons, printable

Look = Callable[[list[Session], bool, ImageReader], None]


def inspect_capture(
    path: Path, format_name: str = "auto", unusable: list[str] | None = None, look: Look | None = None
) -> Iterator[str]:
    """Lines about each recording in `path`; reads everything, writes nothing. The ids of recordings that can't be used
    are added to `unusable`. `look` is called with the sessions of each, whether +y is up in them, and what reads their
    images, while these are there: archives are unpacked for as long as this runs.

    Raises UserError where there is no capture in a known format, or none of its recordings can be read.
    """
    settings = ImportSettings()
    root = path.resolve()
    sessions, errors = list[Session](), list[UserError]()
    with tempfile.TemporaryDirectory() as unpacked:
        reader = ImageReader([root if root.is_dir() else root.parent, Path(unpacked).resolve()], settings.limits)
        unread = list[str]()
        sources = find_recordings(path, Path(unpacked), settings.limits, format_name, unread.append)
        yield from unread
        for source in sources:
            try:
                of_recording, is_usable, is_aligned = yield from _inspect(source, reader, settings)
            except (PluginError, MachineError):
                raise
            except UserError as error:
                if len(sources) == 1:
                    raise
                errors.append(error)
                yield f"{source.recording_id} · {source.format.label}"
                yield f"  status     unusable: {error.line}"
                of_recording, is_usable, is_aligned = [], False, False
            sessions += of_recording
            if look is not None and of_recording:
                look(of_recording, is_aligned, reader)
            if not is_usable and unusable is not None:
                unusable.append(source.recording_id)
    if errors and not sessions:
        raise errors[0]
    _, denser = select_enough(sessions, settings)
    if denser is not None:
        yield f"all recordings: {denser}"


def _inspect(
    source: RecordingSource, reader: ImageReader, settings: ImportSettings
) -> Generator[str, None, tuple[list[Session], bool, bool]]:
    raw = source.read(settings.limits)
    count = sum(frame.image is not None for frame in raw.frames)
    sessions = sound_sessions(
        raw, lambda f: track(reader.check(f), "checking images", len(f)), settings.min_relative_sharpness
    )
    sessions, focal_note = with_focal_length(sessions, reader)
    yield f"{source.recording_id} · {source.format.label} · {raw.device} · clock: {raw.clock}"
    yield f"  log        {len(raw.frames)} rows, {count} with an image"
    yield from _health(sessions, settings)
    origin = far_origin(sessions)
    for note in (*sessions[0].recording.notes, focal_note, "" if origin is None else describe_origin(origin)):
        if note:
            yield f"  note       {note}"
    longest = max(sessions, key=lambda session: len(session.images))
    check = check_convention(longest, reader)
    if check.pairs:
        yield (
            f"  convention {check.declared:.0%} of matched points in {check.pairs} pairs of images fit the poses; "
            f"the next best convention explains {check.other_explained:.0%}"
        )
    clock = check_clock(longest, reader)
    if clock.offset_s is not None:
        yield f"  clock      images fit the poses at {clock.offset_s:+.3f} s (correlation {clock.correlation:.2f})"
    gravity = check_gravity(sessions, reader)
    if gravity.line:
        yield f"  gravity    {gravity.line}"
    implausible = plausibility_faults(sessions)
    for fault in implausible:
        yield f"  warning    {fault.text}"
    why_unusable = _why_unusable(sessions, raw, check, implausible)
    yield f"  status     {why_unusable or _status(sessions, check, gravity.is_aligned, len(implausible))}"
    return sessions, why_unusable is None, gravity.is_aligned


def _health(sessions: Sequence[Session], settings: ImportSettings) -> Iterator[str]:
    used = select(sessions, settings)
    for session in (session for session in sessions if session.frames):
        name = f"{session.session_id}: " if len(sessions) > 1 else ""
        if session.has_poses:
            yield f"  poses      {name}{len(session.frames)}{_motion(session, settings)}"
            states = Counter(frame.tracking for frame in session.frames)
            shares = [f"{state} {n / len(session.frames):.0%}" for state, n in states.most_common()]
            yield f"  tracking   {', '.join(shares)}"
        else:
            yield f"  poses      {name}none"
        if session.images:
            sizes = Counter((image.check.width, image.check.height) for image in session.images)
            low, median, high = np.percentile([image.check.sharpness for image in session.images], [0, 50, 100])
            focal = [image.camera.fx for image in session.images]
            yield (
                f"  images     {len(session.images)} sound, {', '.join(f'{w}x{h}' for w, h in sizes)}, "
                f"fx {min(focal):.1f}..{max(focal):.1f} px, sharpness {low:.2f}..{high:.2f} (median {median:.2f})"
            )
            support = used[session.session_id].support
            rate = f" at {settings.rate_hz:g} Hz" if session.recording.clock.has_times else ", all images without times"
            yield (
                f"  sampling   {len(support) - support.sum()} frames{rate}, {support.sum()} support frames for SfM "
                "between them"
            )
        for jump in session.jumps:
            at_s = (jump.t_ns - session.frames[0].t_ns) * 1e-9
            effect = ", splits the session" if jump.splits else ""
            yield f"  jump       at {at_s:.1f} s: {jump.jump_m:.2f} m, {jump.jump_deg:.1f} deg{effect}"
    reasons = [reject.reason for session in sessions for reject in session.rejects]
    for reason, n in Counter(grouped_reasons(reasons)).most_common(8):
        yield f"  rejected   {n} x {printable(reason)}"


def _motion(session: Session, settings: ImportSettings) -> str:
    """What the times and the unit of a session's poses tell of its motion."""
    seconds, metres = duration(session), path_length(session, settings.reference_is_metric)
    if math.isnan(seconds):
        return ", without times"
    text = f" over {seconds:.1f} s" + (f" ({(len(session.frames) - 1) / seconds:.1f} Hz)" if seconds else "")
    if math.isnan(metres):
        return f"{text}, in an unknown unit"
    return f"{text}, {metres:.1f} m walked" + (f" at {metres / seconds:.2f} m/s" if seconds else "")


def _why_unusable(
    sessions: Sequence[Session], raw: Recording, check: ConventionCheck, implausible: Sequence[PlausibilityFault]
) -> str | None:
    """Why a recording can't be used; None where it can."""
    if not any(session.frames for session in sessions):
        return "unusable: no sound pose" if raw.pose_source != PoseSource.NONE else "unusable: no sound image"
    if remedies := [fault.remedy for fault in implausible if fault.remedy]:
        return f"unusable: not plausible, by the warning above; {remedies[0]}"
    if not any(session.images for session in sessions) and any(frame.image is not None for frame in raw.frames):
        return "unusable: no sound image"
    return f"wrong convention: {check.contradicted}" if check.contradicted else None


def _status(sessions: Sequence[Session], check: ConventionCheck, has_gravity: bool, warnings: int) -> str:
    """What a recording that can be used is good for."""
    if not any(session.images for session in sessions):
        return "poses only: of use to study odometry, not as a data set"
    faults = [f"{warnings} warning{'s' * (warnings > 1)} above"] if warnings else []
    if check.pairs and check.declared < MIN_EXPLAINED:
        faults.append("its poses fit its images badly")
    if not sessions[0].has_poses:
        faults.append("images alone: its map has no scale and no vertical, and nothing but the images checks it")
    elif not sessions[0].has_vio:
        faults.append("its poses are a reference, not VIO")
    elif not has_gravity:
        faults.append("its gravity is unknown, by the line above")
    if len(sessions) > 1 and sessions[0].has_poses:
        faults.append(f"VIO jumps split it into {len(sessions)} sessions")
    if rejects := sum(len(session.rejects) for session in sessions):
        faults.append(f"{rejects} rows are rejected")
    return "good" if not faults else "usable: " + "; ".join(faults)
