"""Checks of each session in one SfM model: focal length, motion, turns, perceptual aliasing, scale and vertical.

Where there is no standard error, frames are counted: all of them, not a sample.
"""

from dataclasses import dataclass, replace

import numpy as np

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Rows, Subject, evaluate
from groundwalk.alignment.components import Component
from groundwalk.alignment.segments import Segment, registered_rows, sessions_of
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import FocalEstimate, SfmTables
from groundwalk.consistency.decisions import Status, fraction_sd
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR, Diagnosis, diagnose
from groundwalk.consistency.motions import MIRRORED, MISTAKE_REASONS, UNRELATED, UPSIDE_DOWN
from groundwalk.consistency.vio_drift import VIO_DRIFT
from groundwalk.geometry.fits import direction_angles
from groundwalk.store.choices import CheckName, FailureCause

# VIO explains most relative poses of a session whose images and poses belong together, however badly it drifts.
_MIN_MOTION_AGREEMENT = 0.5
_BENT = "a session with wrong intrinsics bends its SfM model"
# Faults by which no part of a model is right.
_FAULTS_OF_MODEL = {
    CheckName.SESSION_ALIASING: "perceptual aliasing: distinct places are merged in its SfM model",
    CheckName.SESSION_TURNS: _BENT,
    CheckName.SESSION_FOCAL_LENGTH: _BENT,
}
_INCONSISTENT = (FailureCause.VIO_INCONSISTENT, "most relative poses in SfM are inconsistent with VIO")
_CAUSES = {
    MIRRORED: FailureCause.MIRRORED_IMAGES,
    UPSIDE_DOWN: FailureCause.MIRRORED_IMAGES,
    UNRELATED: FailureCause.MISMATCHED_IMAGES,
}


@dataclass(frozen=True, kw_only=True)
class SessionEvidence:
    """What is known of a session in an SfM model: its registered `rows` of the frames table, its motion against VIO,
    its focal length by the images (None: unknown); without VIO nothing else is checked. `pairs_match_vio`: pairs of its
    images, without any model, move as VIO does, so that images and poses belong together and the model is what is
    wrong."""

    subject: Subject
    recording: str
    rows: Rows
    segments: list[Segment]
    component: Component
    diagnosis: Diagnosis
    focal: FocalEstimate | None
    pairs_match_vio: bool


def check_sessions(component: Component, sfm: SfmTables, settings: AlignSettings) -> list[CheckResult]:
    """All checks of the sessions of a model. A session that fails one gets no ground truth, nor does any frame of a
    model that the fault leaves nothing of right."""
    results: list[CheckResult] = []
    for session_id in sessions_of(component.segments):
        segments = [s for s in component.segments if s.session_id == session_id]
        rows = registered_rows(segments)
        if len(rows):
            evidence = SessionEvidence(
                subject=Subject(len(rows), session_id, component.index),
                recording=segments[0].recording,
                rows=rows,
                segments=segments,
                component=component,
                diagnosis=diagnose([s.trajectory_pair for s in segments], VIO_DRIFT),
                focal=sfm.focal(component.model_id, session_id),
                pairs_match_vio=sfm.pairs_match_vio(session_id),
            )
            results += [_with_model(result, component) for result in _check_session(evidence, settings)]
    return results


def _check_session(evidence: SessionEvidence, settings: AlignSettings) -> list[CheckResult]:
    focal = check_focal_length(evidence.subject, evidence.rows, evidence.focal, settings.max_focal_error)
    if not any(segment.has_vio.any() for segment in evidence.segments):
        return [focal] if focal is not None else []
    motion = check_motion(evidence)
    results = [focal, motion, check_turns(evidence, focal, motion), check_aliasing(evidence, motion)]
    # A scale or vertical by wrong poses decides nothing.
    if not any(r is not None and r.status is Status.FAILED for r in results):
        results += [
            check_scale(evidence, settings.max_session_scale_error),
            check_vertical(evidence, settings.max_session_tilt_deg),
        ]
    return [result for result in results if result is not None]


def _with_model(result: CheckResult, component: Component) -> CheckResult:
    if result.status is not Status.FAILED or result.name not in _FAULTS_OF_MODEL:
        return result
    of_model = Exclusion(component.registered_rows, _FAULTS_OF_MODEL[result.name], is_of_model=True)
    return replace(result, exclusions=(*result.exclusions, of_model))


def check_focal_length(subject: Subject, rows: Rows, focal: FocalEstimate | None, limit: float) -> CheckResult | None:
    """The focal length by the images against the captured one; None where the images don't determine it. Undecided it
    lowers no frame's class: SfM used the estimated one, and its standard error is in the frames' covariances. Where it
    steps, some frames are off by half of the step."""
    if focal is None:
        return None
    error = focal.scale - 1
    reason = f"focal length by the images is {abs(error):.1%} {'longer' if error > 0 else 'shorter'} than captured"
    estimate = Quantity(abs(error), focal.sd)
    if focal.step is not None:
        reason += f", {focal.step:.3f} times as long from {focal.step_frame_id} on: digital zoom or another lens"
        half_step = abs(focal.step - 1) / 2
        if half_step > abs(error):
            # A step is one by being beyond all scatter.
            estimate = Quantity(half_step, 0.0)
    failure = Failure(cause=FailureCause.WRONG_INTRINSICS, reason=reason, rows=rows, lowers_class=False)
    return evaluate(CheckName.SESSION_FOCAL_LENGTH, subject, estimate, limit, failure)


def check_motion(evidence: SessionEvidence) -> CheckResult:
    """The fraction of steps that VIO explains; each frame is in about two of them, which are correlated."""
    motions = evidence.diagnosis.motions
    cause, reason = _INCONSISTENT
    if motions.mistake is not None and not evidence.pairs_match_vio:
        cause, reason = _CAUSES[motions.mistake], MISTAKE_REASONS[motions.mistake]
    # Mirrored images are a fault although a straight walk agrees: the mirrored motion must explain more.
    is_mirrored = cause is FailureCause.MIRRORED_IMAGES
    limit = max(motions.mirrors.values()) if is_mirrored else _MIN_MOTION_AGREEMENT
    estimate = Quantity(motions.explained, fraction_sd(motions.explained, motions.pairs / 2))
    failure = Failure(cause=cause, reason=reason, rows=evidence.rows)
    return evaluate(CheckName.SESSION_MOTION, evidence.subject, estimate, limit, failure)


def check_turns(evidence: SessionEvidence, focal: CheckResult | None, motion: CheckResult) -> CheckResult | None:
    """How much more or less SfM turns than VIO, as by a wrong focal length. None where motion disagrees altogether, the
    session hardly turns, or the images confirm the focal length: then VIO is what turns wrongly."""
    motions = evidence.diagnosis.motions
    is_confirmed = evidence.focal is not None and evidence.focal.is_confirmed
    if is_confirmed or not np.isfinite(motions.turn_gain) or motion.status is Status.FAILED:
        return None
    error = motions.turn_gain - 1
    failure = Failure(
        cause=FailureCause.WRONG_INTRINSICS,
        reason=f"SfM turns {abs(error):.1%} {'less' if error < 0 else 'more'} than VIO: the focal length isn't the "
        "captured one",
        rows=evidence.rows,
        # A focal length that passed has its standard error in the frames' covariances.
        lowers_class=focal is None or focal.status is not Status.PASSED,
    )
    estimate = Quantity(abs(error), motions.turn_gain_sd)
    return evaluate(CheckName.SESSION_TURNS, evidence.subject, estimate, MAX_TURN_GAIN_ERROR, failure)


def check_aliasing(evidence: SessionEvidence, motion: CheckResult) -> CheckResult | None:
    """The fraction of frames at places that are far apart in VIO; None where images and poses don't belong together."""
    if motion.status is Status.FAILED and not evidence.pairs_match_vio:
        return None
    failure = Failure(
        cause=FailureCause.PERCEPTUAL_ALIASING,
        reason=f"SfM merges places that are up to {evidence.diagnosis.aliased_m:.1f} m apart in VIO",
        rows=evidence.rows,
    )
    estimate = Quantity(evidence.diagnosis.aliased_fraction)
    return evaluate(CheckName.SESSION_ALIASING, evidence.subject, estimate, MAX_ALIASED_FRACTION, failure)


def check_scale(evidence: SessionEvidence, limit: float) -> CheckResult | None:
    """The scale by the session's recording against the map's; None for the only recording. Undecided it lowers no
    frame's class: the scale is what all frames share, and windows are compared at the map's."""
    scale = evidence.component.vio_scale
    if evidence.recording not in scale.recordings or len(scale.recordings) < 2:
        return None
    of_recording = scale.recordings[evidence.recording]
    error = float(np.expm1(of_recording.log - scale.log))
    failure = Failure(
        cause=FailureCause.WRONG_VIO_SCALE,
        reason=f"this session's VIO measures {abs(error):.1%} {'more' if error > 0 else 'less'} than the others'",
        rows=evidence.rows,
        lowers_class=False,
    )
    estimate = Quantity(abs(error), of_recording.sd)
    return evaluate(CheckName.SESSION_SCALE, evidence.subject, estimate, limit, failure)


def check_vertical(evidence: SessionEvidence, limit_deg: float) -> CheckResult | None:
    """The vertical by the session's recording against the map's; otherwise as for the scale. Where recordings differ
    and nothing tells which is right, each is undecided."""
    vertical = evidence.component.vertical
    if evidence.recording not in vertical.recordings or len(vertical.recordings) < 2:
        return None
    of_recording = vertical.recordings[evidence.recording]
    others = [other.up_sfm for name, other in vertical.recordings.items() if name != evidence.recording]
    ups = np.stack([vertical.up_sfm] if vertical.is_agreed else others)
    tilt_deg = float(np.degrees(direction_angles(ups, of_recording.up_sfm).max()))
    failure = Failure(
        cause=FailureCause.WRONG_VIO_GRAVITY,
        reason=f"this session's gravity points {tilt_deg:.1f} degrees away from the others'",
        rows=evidence.rows,
        lowers_class=False,
    )
    estimate = Quantity(tilt_deg, float(np.degrees(of_recording.sd)))
    status = None if vertical.is_agreed else Status.UNDECIDED
    return evaluate(CheckName.SESSION_VERTICAL, evidence.subject, estimate, limit_deg, failure, status)
