"""Checks of each session in one model: focal length, motion, folded places, and scale and vertical against the others.

What has no standard error here is counted over all frames rather than estimated from some: shares of registered and of
folded frames.
"""

from dataclasses import dataclass, replace

import numpy as np

from groundwalk.alignment.checks import (
    DISAGREES,
    INTRINSICS,
    LOOK_ALIKE,
    MIRRORED,
    SHUFFLED,
    VIO_SCALE,
    VIO_VERTICAL,
    About,
    Check,
    check,
)
from groundwalk.alignment.components import Component
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import Focal, SfmTables
from groundwalk.consistency.decisions import Status, fraction_sd
from groundwalk.consistency.diagnosis import Diagnosis, diagnose
from groundwalk.consistency.motions import MISTAKE_REASONS, UNRELATED, MotionAgreement
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.geometry.fits import direction_angles

# Faults that leave no part of a model right: which of two places is it, and how far does one focal length bend all?
_OF_THE_WHOLE = {
    "session_folded": "look-alike places are folded together in its model",
    "session_turns": "its model is bent by a session whose intrinsics are wrong",
    "session_focal": "its model is bent by a session whose intrinsics are wrong",
}
_OTHERWISE = (DISAGREES, "SfM moves otherwise than VIO in most steps")


@dataclass(frozen=True)
class Session:
    """A session in a model: its rows of the frames table, and what its checks are about."""

    about: About
    rows: np.ndarray
    settings: AlignSettings


def check_sessions(component: Component, sfm: SfmTables, drift: VioDrift, settings: AlignSettings) -> list[Check]:
    """All checks of the sessions of a model. A session that fails one gets no ground truth, and no frame of the model
    does where the fault leaves no part of it right."""
    checks: list[Check] = []
    rows_of_model = np.concatenate([s.rows[s.registered] for s in component.segments])
    for session_id in dict.fromkeys(s.session_id for s in component.segments):
        segments = [s for s in component.segments if s.session_id == session_id]
        rows = np.concatenate([s.rows[s.registered] for s in segments])
        if not len(rows):
            continue
        session = Session(About(len(rows), session_id, component.index), rows, settings)
        diagnosis = diagnose([p.trajectory_pair for p in component.pieces if p.session_id == session_id], drift)
        focal = sfm.focal(component.model_id, session_id)
        results = _motion_checks(session, diagnosis, focal, belongs=sfm.belongs(session_id))
        if all(c.status is not Status.FAILED for c in results):
            # A scale or vertical by poses that are wrong themselves would tell nothing.
            results += _shared_checks(session, component, segments[0].recording)
        checks += [
            replace(c, refused_too=rows_of_model, model_reason=_OF_THE_WHOLE[c.name])
            if c.status is Status.FAILED and c.name in _OF_THE_WHOLE
            else c
            for c in results
        ]
    return checks


def _motion_checks(session: Session, diagnosis: Diagnosis, focal: Focal | None, *, belongs: bool) -> list[Check]:
    """Checks of a session by itself. `belongs`: pairs of its images, without any model, move as its VIO does, so that
    they do belong to its poses and the model is what is wrong."""
    checks = [] if focal is None else [check_focal(session, focal)]
    motion = _check_motion(session, diagnosis.motions, belongs=belongs)
    checks.append(motion)
    if motion.status is Status.FAILED and not belongs:
        # Turns and places say nothing where motions don't agree at all.
        return checks
    # Where the images themselves confirm the focal length, it's VIO that turns otherwise.
    gain = diagnosis.motions.turn_gain
    if np.isfinite(gain) and motion.status is not Status.FAILED and (focal is None or not focal.confirmed):
        # What the images say of the focal length is in each frame's own uncertainty.
        is_known = any(c.name == "session_focal" and c.status is Status.PASSED for c in checks)
        checks.append(_check_turns(session, gain, diagnosis.motions.turn_gain_sd, is_of_frames=not is_known))
    folded = check(
        "session_folded",
        diagnosis.aliased_fraction,
        None,
        session.settings.folded_limit,
        session.about,
        LOOK_ALIKE,
        f"SfM puts places together that VIO has up to {diagnosis.aliased_m:.1f} m apart",
        rows=session.rows,
    )
    return [*checks, folded]


def check_focal(session: Session, focal: Focal) -> Check:
    """What the images say of the captured focal length. Undecided it costs no frame its class: SfM has taken the
    images' focal length, and its standard error is in the frames' covariances."""
    off = focal.scale - 1
    return check(
        "session_focal",
        abs(off),
        focal.sd,
        session.settings.focal_limit,
        session.about,
        INTRINSICS,
        f"the images say that the focal length is {abs(off):.1%} {'more' if off > 0 else 'less'} than captured",
        rows=session.rows,
        is_of_frames=False,
    )


def _check_motion(session: Session, motions: MotionAgreement, *, belongs: bool) -> Check:
    """The share of steps that VIO explains; each frame is in about two of them, which hang together."""
    cause, reason = _OTHERWISE
    if motions.mistake is not None and not belongs:
        cause, reason = SHUFFLED if motions.mistake == UNRELATED else MIRRORED, MISTAKE_REASONS[motions.mistake]
    # A mirror image that explains clearly more is a fault, however much a walk straight on agrees all the same.
    limit = max(motions.mirrors.values()) if cause == MIRRORED else session.settings.motion_agreeing
    return check(
        "session_motion",
        motions.explained,
        fraction_sd(motions.explained, motions.pairs / 2),
        limit,
        session.about,
        cause,
        reason,
        rows=session.rows,
    )


def _check_turns(session: Session, gain: float, sd: float, *, is_of_frames: bool) -> Check:
    word = "less" if gain < 1 else "more"
    return check(
        "session_turns",
        abs(gain - 1),
        sd,
        session.settings.turn_gain_limit,
        session.about,
        INTRINSICS,
        f"SfM turns {abs(gain - 1):.1%} {word} than VIO: the focal length isn't the captured one",
        rows=session.rows,
        is_of_frames=is_of_frames,
    )


def _shared_checks(session: Session, component: Component, recording: str) -> list[Check]:
    """A session's scale and vertical against the map's; one recording has no other to differ from. Undecided they cost
    no frame its class: they are about what all frames share, and windows hold its poses at the map's scale."""
    checks = []
    scale, vertical, settings = component.vio_scale, component.vertical, session.settings
    if recording in scale.recordings and len(scale.recordings) > 1:
        off = float(np.expm1(scale.recordings[recording].log - scale.log))
        checks.append(
            check(
                "session_scale",
                abs(off),
                scale.recordings[recording].sd,
                settings.session_scale_limit,
                session.about,
                VIO_SCALE,
                f"this session's VIO measures {abs(off):.1%} {'more' if off > 0 else 'less'} than the others'",
                rows=session.rows,
                is_of_frames=False,
            )
        )
    if recording in vertical.recordings and len(vertical.recordings) > 1:
        own = vertical.recordings[recording]
        tilt_deg = float(np.degrees(direction_angles(own.up_sfm[None], vertical.up_sfm)[0]))
        checks.append(
            check(
                "session_vertical",
                tilt_deg,
                float(np.degrees(own.sd)),
                settings.session_tilt_limit_deg,
                session.about,
                VIO_VERTICAL,
                f"this session's gravity points {tilt_deg:.1f} degrees away from the others'",
                rows=session.rows,
                is_of_frames=False,
            )
        )
    return checks
