"""Is what a recording says possible: its speed, the rate of its poses, that it moves, and the number of its images?

What still can be used is a warning, since phones ride in vehicles and lifts, too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from groundwalk.capture_import.capture import Session
from groundwalk.store.hints import setting_of

# The median speed of a runner; walks with a phone are below 2 m/s.
MAX_WALK_M_S = 3.0
# Faster than any train: a wrong unit for sure. A walk in centimetres or with times in another unit mostly is, and one
# in metres never.
MAX_SPEED_M_S = 100.0
# Apps log poses at 1 to 60 Hz, inertial odometry at 1000 Hz at most. A unit of time is wrong by a factor of 1000 or
# more, which takes 60 Hz to 0.06 Hz, and 2 Hz to 2000 Hz.
MIN_RATE_HZ, MAX_RATE_HZ = 0.1, 1000.0
# A hand shakes more than that even where the phone only turns.
_MIN_EXTENT_M = 0.002
# Without a unit, poses in one place differ by this fraction of their coordinates at most.
_ROUNDING = 1e-12
# Sharpness after Crete: of phones' images 0.6 to 0.85; out of focus by half a hundredth of their width or more, 0.14 to
# 0.33.
_MIN_SHARPNESS = 0.35
# And faster, most of the time or at least now and then.
_MIN_SPEED_M_S = 0.01
_USUAL_SPEED_M_S = 0.03
_AS_PHOTOS = 'format = "photos"'
_UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048, "kilometres": 1e3}


@dataclass(frozen=True)
class PlausibilityFault:
    """What isn't plausible of a recording, with its figures; where nothing can be made of it, what to do."""

    text: str
    remedy: str = ""


def plausibility_faults(sessions: Sequence[Session]) -> list[PlausibilityFault]:
    """What isn't plausible of a recording, by all its sessions. Speed and rate are looked at where the poses are the
    phone's: a reference has no unit or no times as often as not."""
    sessions = [session for session in sessions if session.frames]
    if not sessions:
        return []
    # All parts together: a jump between them is one step of many, and medians don't see it.
    poses = np.concatenate([session.poses for session in sessions])
    t_ns = np.concatenate([session.t_ns for session in sessions])
    motion = _of_motion(t_ns, poses[:, :3, 3]) if sessions[0].has_vio and len(t_ns) > 1 else ()
    return [*motion, *_of_images(sessions, poses)]


def _of_motion(t_ns: np.ndarray, xyz: np.ndarray) -> Iterator[PlausibilityFault]:
    dt_s = np.diff(t_ns) * 1e-9
    speeds = np.linalg.norm(np.diff(xyz, axis=0), axis=1) / dt_s
    median, high = np.percentile(speeds, [50, 95])
    if median > MAX_WALK_M_S:
        yield PlausibilityFault(
            f"VIO moves at {median:.4g} m/s (median; 95th percentile {high:.4g} m/s), a walk is below "
            f"{MAX_WALK_M_S:g} m/s: {_unit_guess(median)}, or time stamps in another than their format's?",
            remedy="correct the log: docs/reference/capture-formats.md says the units of each format"
            if median > MAX_SPEED_M_S
            else "",
        )
    interval_s = float(np.median(dt_s))
    if not MIN_RATE_HZ <= 1 / interval_s <= MAX_RATE_HZ:
        yield PlausibilityFault(
            f"poses come at {1 / interval_s:.4g} Hz (median interval {interval_s:.4g} s), expected "
            f"{MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz: are time stamps in another unit than their format's?"
        )
    elif 0 < high < _MIN_SPEED_M_S:
        yield PlausibilityFault(
            f"VIO moves at {median:.2g} m/s (median; 95th percentile {high:.2g} m/s), a phone in a hand is faster than "
            f"{_MIN_SPEED_M_S:g} m/s at times: {_unit_guess(high)}?"
        )


def _unit_guess(speed_m_s: float) -> str:
    """Which unit would make a speed one of a walk."""
    text = "are positions in another unit than metres"
    for name, metres in _UNITS.items():
        if _USUAL_SPEED_M_S <= speed_m_s * metres <= MAX_WALK_M_S:
            return f"{text} (in {name} it would be {speed_m_s * metres:.2g} m/s)"
    return text


def _of_images(sessions: Sequence[Session], poses: np.ndarray) -> Iterator[PlausibilityFault]:
    images = [image for session in sessions for image in session.images]
    if len(images) == 1:
        yield PlausibilityFault("it has one image: a model needs many that overlap")
    if not sessions[0].has_poses:
        # Where nothing but images says anything, some have to be sharp.
        sharpest = max((image.check.sharpness for image in images), default=1.0)
        if sharpest < _MIN_SHARPNESS:
            yield PlausibilityFault(
                f"none of {len(images)} images is sharp: the sharpest has {sharpest:.2f} of 1 (at least "
                f"{_MIN_SHARPNESS:g})",
                remedy="record it again: in more light, slowly, with a clean lens and in focus",
            )
        return
    # The hash of a video's frame isn't known before it is written; its sharpness tells frames apart as well.
    different = len({(image.check.sha256, image.check.sharpness) for image in images})
    if different < 2:
        return
    xyz = poses[:, :3, 3]
    extent_m = float(np.linalg.norm(np.ptp(xyz, axis=0)))
    if sessions[0].has_vio and len(poses) > 1 and (poses == poses[0]).all():
        yield PlausibilityFault(
            f"all {len(xyz)} poses are equal while {different} images differ: odometry didn't run, as in captures by "
            "the front camera (Face ID)",
            remedy="record with the camera at the back and tracking on; or read its images alone, without poses: "
            f"{setting_of('import', _AS_PHOTOS)}, or inspect --format photos",
        )
    elif not sessions[0].recording.is_metric:
        if extent_m <= _ROUNDING * float(np.abs(xyz).max()):
            yield PlausibilityFault(f"all {len(xyz)} poses lie in one place while {different} images differ")
    elif extent_m < _MIN_EXTENT_M:
        seconds = max(float(session.t_ns[-1] - session.t_ns[0]) * 1e-9 for session in sessions)
        yield PlausibilityFault(
            f"all {len(xyz)} poses lie within {1000 * extent_m:.2g} mm over {seconds:.1f} s while {different} images "
            "differ: did odometry run?"
        )
