"""What a capture holds, its health and whether it can be used, for reading on a terminal."""

import math
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path

import numpy as np

from groundwalk.capture_import.capture import RawSession
from groundwalk.capture_import.checks.clock import check_clock
from groundwalk.capture_import.checks.convention import MIN_EXPLAINED, ConventionCheck, check_convention
from groundwalk.capture_import.checks.gravity import GravityCheck, check_gravity
from groundwalk.capture_import.checks.plausibility import PlausibilityFault, plausibility_faults
from groundwalk.capture_import.checks.views import Views
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.intake import ImportedSession, Intake, duration, measures, path_length, take_in
from groundwalk.capture_import.origin import describe_origin, far_origin
from groundwalk.capture_import.selection import select, select_enough
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.capture_import.tables import printable
from groundwalk.store.choices import PoseSource
from groundwalk.store.progress import track
from groundwalk.store.text import grouped_reasons


def inspect_capture(path: Path, format_name: str = "auto", unusable: list[str] | None = None) -> Iterator[str]:
    """Lines about each recording in `path`; reads everything, writes nothing. The ids of recordings that can't be used
    are added to `unusable`.

    Raises UserError where there is no capture in a known format.
    """
    settings = ImportSettings()
    root = path.resolve()
    sessions: list[ImportedSession] = []
    with tempfile.TemporaryDirectory() as unpacked:
        roots = [root if root.is_dir() else root.parent, Path(unpacked).resolve()]
        for source in find_recordings(path, Path(unpacked), settings.limits, format_name):
            intake, is_usable = yield from _inspect(source, Views(roots, settings.limits), settings)
            sessions += intake.sessions
            if not is_usable and unusable is not None:
                unusable.append(source.session_id)
    _, denser = select_enough(sessions, settings)
    if denser is not None:
        yield f"all recordings: {denser}"


def _inspect(
    source: RecordingSource, views: Views, settings: ImportSettings
) -> Generator[str, None, tuple[Intake, bool]]:
    raw = source.read(settings.limits)
    count = sum(f.image is not None for f in raw.frames)
    intake = take_in(raw, settings, lambda f: track(measures(views.scan(f)), "checking images", len(f)))
    yield f"{source.session_id} · {source.format.label} · {raw.device} · clock: {raw.clock}"
    yield f"  log        {len(raw.frames)} rows, {count} with an image"
    yield from _health(intake, settings)
    origin = far_origin(intake.sessions)
    for note in (*raw.notes, *([] if origin is None else [describe_origin(origin)])):
        yield f"  note       {note}"
    longest = max(intake.sessions, key=lambda s: len(s.images))
    check = check_convention(longest, views.load)
    if check.pairs:
        yield (
            f"  convention {check.declared:.0%} of matched points in {check.pairs} pairs of images fit the poses; "
            f"the next best convention explains {check.other_explained:.0%}"
        )
    clock = check_clock(longest, views.load)
    if clock.offset_s is not None:
        yield f"  clock      images fit the poses at {clock.offset_s:+.3f} s (correlation {clock.correlation:.2f})"
    gravity = check_gravity(intake, views.load)
    if gravity.line:
        yield f"  gravity    {gravity.line}"
    implausible = plausibility_faults(intake)
    for fault in implausible:
        yield f"  warning    {fault.text}"
    why_unusable = _fault(intake, raw, check, implausible)
    yield f"  status     {why_unusable or _status(intake, raw, check, gravity, implausible)}"
    return intake, why_unusable is None


def _health(intake: Intake, settings: ImportSettings) -> Iterator[str]:
    used = select(intake.sessions, settings)
    for session in intake.sessions:
        if not session.frames:
            continue
        t_ns, poses = session.t_ns, session.poses
        name = f"{session.session_id}: " if len(intake.sessions) > 1 else ""
        yield f"  poses      {name}{len(poses)}{_motion(session, settings)}"
        states = Counter(f.tracking for f in session.frames)
        yield "  tracking   " + ", ".join(f"{state} {n / len(poses):.0%}" for state, n in states.most_common())
        if session.images:
            checks = [i.check for i in session.images]
            sizes = Counter((c.width, c.height) for c in checks)
            sharp = np.percentile([c.sharpness for c in checks], [0, 50, 100])
            focal = [i.frame.intrinsics.fx for i in session.images if i.frame.intrinsics]
            yield (
                f"  images     {len(checks)} sound, "
                + ", ".join(f"{w}x{h}" for w, h in sizes)
                + f", fx {min(focal):.1f}..{max(focal):.1f} px, "
                f"sharpness {sharp[0]:.2f}..{sharp[2]:.2f} (median {sharp[1]:.2f})"
            )
            support = used[session.session_id].support
            rate = f" at {settings.rate_hz:g} Hz" if session.recording.clock.has_times else ", all images without times"
            frames = f"{len(support) - support.sum()} frames{rate}"
            yield f"  sampling   {frames}, {support.sum()} support frames for SfM between them"
        for jump, splits in session.jumps:
            at = (jump.t_ns - int(t_ns[0])) * 1e-9
            effect = ", splits the session" if splits else ""
            yield f"  jump       at {at:.1f} s: {jump.jump_m:.2f} m, {jump.jump_deg:.1f} deg{effect}"
    for reason, n in Counter(grouped_reasons([reject.reason for reject in intake.rejects])).most_common(8):
        yield f"  rejected   {n} x {printable(reason)}"


def _motion(session: ImportedSession, settings: ImportSettings) -> str:
    """What the times and the unit of a session's poses tell of its motion."""
    seconds, metres = duration(session), path_length(session, settings.reference_is_metric)
    if math.isnan(seconds):
        return ", without times"
    text = f" over {seconds:.1f} s" + (f" ({(len(session.frames) - 1) / seconds:.1f} Hz)" if seconds else "")
    if math.isnan(metres):
        return f"{text}, in an unknown unit"
    return f"{text}, {metres:.1f} m walked" + (f" at {metres / seconds:.2f} m/s" if seconds else "")


def _fault(
    intake: Intake, raw: RawSession, check: ConventionCheck, implausible: Sequence[PlausibilityFault]
) -> str | None:
    """Why a recording can't be used; None where it can."""
    images = sum(len(s.images) for s in intake.sessions)
    if not any(s.frames for s in intake.sessions):
        return "unusable: no sound pose"
    if any(fault.is_unusable for fault in implausible):
        return "unusable: not plausible, by the warning above"
    if not images and any(frame.image is not None for frame in raw.frames):
        return "unusable: no sound image"
    return f"wrong convention: {check.contradicted}" if check.contradicted else None


def _status(
    intake: Intake,
    raw: RawSession,
    check: ConventionCheck,
    gravity: GravityCheck,
    implausible: Sequence[PlausibilityFault],
) -> str:
    """What a recording that can be used is good for."""
    if not any(s.images for s in intake.sessions):
        return "poses only: of use to study odometry, not as a data set"
    faults = [f"{len(implausible)} warning{'s' * (len(implausible) > 1)} above"] if implausible else []
    if check.pairs and check.declared < MIN_EXPLAINED:
        faults.append("its poses fit its images badly")
    if raw.pose_source == PoseSource.REFERENCE:
        faults.append("its poses are a reference, not VIO")
    elif not gravity.is_aligned:
        faults.append("its gravity is unknown, by the line above")
    if len(intake.sessions) > 1:
        faults.append(f"VIO jumps split it into {len(intake.sessions)} sessions")
    if intake.rejects:
        faults.append(f"{len(intake.rejects)} rows are rejected")
    return "good" if not faults else "usable: " + "; ".join(faults)
