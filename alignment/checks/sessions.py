"""Checks of each session in one SfM model: focal length, motion, turns, perceptual aliasing, scale and vertical; and
window by window whether SfM and VIO agree: where they don't, the model is wrong or VIO jumped.

Where there is no standard error, frames are counted: all of them, not a sample.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Rows, Subject, evaluate
from groundwalk.alignment.components import Component, MapScale, Vertical
from groundwalk.alignment.segments import SegmentWindow, registered_rows, sessions_of
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import FocalEstimate, SfmTables
from groundwalk.consistency.decisions import SIGMAS, Status, beyond, fraction_sd, within
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR, Diagnosis, diagnose
from groundwalk.consistency.motions import MIRRORED, MISTAKE_REASONS, UNRELATED, UPSIDE_DOWN
from groundwalk.consistency.windows import compare_windows
from groundwalk.geometry.fits import direction_angles
from groundwalk.geometry.poses import Array
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
_CAUSES = {
    MIRRORED: FailureCause.MIRRORED_IMAGES,
    UPSIDE_DOWN: FailureCause.MIRRORED_IMAGES,
    UNRELATED: FailureCause.MISMATCHED_IMAGES,
}
_APART = "pose in SfM inconsistent with VIO"


def check_sessions(component: Component, sfm: SfmTables, settings: AlignSettings) -> list[CheckResult]:
    """All checks of the sessions of a model. A session that fails one gets no ground truth, nor does any frame of a
    model that the fault leaves nothing of right; without VIO only its focal length is checked."""
    results: list[CheckResult] = []
    for session_id in sessions_of(component.segments):
        segments = [s for s in component.segments if s.session_id == session_id]
        rows, recording = registered_rows(segments), segments[0].recording
        if not len(rows):
            continue
        subject = Subject(len(rows), session_id, component.index)
        focal = sfm.focal(component.model_id, session_id)
        of_focal = check_focal_length(subject, rows, focal, settings.max_focal_error)
        found = [of_focal]
        if any(segment.has_vio.any() for segment in segments):
            diagnosis = diagnose([s.trajectory_pair for s in segments])
            # Pairs of its images, without any model, move as VIO does: images and poses belong together, and the model
            # is what is wrong.
            pairs_match = sfm.pairs_match_vio(session_id)
            motion = _motion(subject, rows, diagnosis, pairs_match=pairs_match)
            found.append(motion)
            if motion.status is not Status.FAILED and not (focal is not None and focal.is_confirmed):
                found.append(_turns(subject, rows, diagnosis, of_focal))
            if motion.status is not Status.FAILED or pairs_match:
                found.append(_aliasing(subject, rows, diagnosis))
            # A scale or vertical by wrong poses decides nothing.
            if not any(r is not None and r.status is Status.FAILED for r in found):
                found.append(_scale(subject, rows, component.vio_scale, recording, settings.max_session_scale_error))
                found.append(_vertical(subject, rows, component.vertical, recording, settings.max_session_tilt_deg))
        results += [result for result in found if result is not None]
    for number, result in enumerate(results):
        if result.status is Status.FAILED and result.name in _FAULTS_OF_MODEL:
            of_model = Exclusion(component.registered_rows, _FAULTS_OF_MODEL[result.name], is_of_model=True)
            results[number] = replace(result, exclusions=(*result.exclusions, of_model))
    return results


def check_focal_length(subject: Subject, rows: Rows, focal: FocalEstimate | None, limit: float) -> CheckResult | None:
    """The focal length by the images against the captured one; None where the images don't determine it. Undecided it
    lowers no frame's class: SfM used the estimated one, and its standard error is in the frames' covariances."""
    if focal is None:
        return None
    error = focal.scale - 1
    reason = f"focal length by the images is {abs(error):.1%} {'longer' if error > 0 else 'shorter'} than captured"
    failure = Failure(FailureCause.WRONG_INTRINSICS, reason, rows, lowers_class=False)
    return evaluate(CheckName.SESSION_FOCAL_LENGTH, subject, Quantity(abs(error), focal.sd), limit, failure)


def _motion(subject: Subject, rows: Rows, diagnosis: Diagnosis, *, pairs_match: bool) -> CheckResult:
    """The fraction of steps that VIO explains; each frame is in about two of them, which are correlated."""
    motions = diagnosis.motions
    cause, reason = FailureCause.VIO_INCONSISTENT, "most relative poses in SfM are inconsistent with VIO"
    if motions.mistake is not None and not pairs_match:
        cause, reason = _CAUSES[motions.mistake], MISTAKE_REASONS[motions.mistake]
    # Mirrored images are a fault although a straight walk agrees: the mirrored motion must explain more.
    is_mirrored = cause is FailureCause.MIRRORED_IMAGES
    limit = max(motions.mirrors.values()) if is_mirrored else _MIN_MOTION_AGREEMENT
    estimate = Quantity(motions.explained, fraction_sd(motions.explained, motions.pairs / 2))
    return evaluate(CheckName.SESSION_MOTION, subject, estimate, limit, Failure(cause, reason, rows))


def _turns(subject: Subject, rows: Rows, diagnosis: Diagnosis, focal: CheckResult | None) -> CheckResult | None:
    """How much more or less SfM turns than VIO, as by a wrong focal length. None where the session hardly turns."""
    motions = diagnosis.motions
    if not np.isfinite(motions.turn_gain):
        return None
    error = motions.turn_gain - 1
    turns = f"SfM turns {abs(error):.1%} {'less' if error < 0 else 'more'} than VIO"
    reason = f"{turns}: the focal length isn't the captured one"
    # A focal length that passed has its standard error in the frames' covariances.
    lowers_class = focal is None or focal.status is not Status.PASSED
    failure = Failure(FailureCause.WRONG_INTRINSICS, reason, rows, lowers_class)
    estimate = Quantity(abs(error), motions.turn_gain_sd)
    return evaluate(CheckName.SESSION_TURNS, subject, estimate, MAX_TURN_GAIN_ERROR, failure)


def _aliasing(subject: Subject, rows: Rows, diagnosis: Diagnosis) -> CheckResult:
    """The fraction of frames at places that are far apart in VIO."""
    reason = f"SfM merges places that are up to {diagnosis.aliased_m:.1f} m apart in VIO"
    failure = Failure(FailureCause.PERCEPTUAL_ALIASING, reason, rows)
    estimate = Quantity(diagnosis.aliased_fraction)
    return evaluate(CheckName.SESSION_ALIASING, subject, estimate, MAX_ALIASED_FRACTION, failure)


def _scale(subject: Subject, rows: Rows, scale: MapScale, recording: str, limit: float) -> CheckResult | None:
    """The scale by the session's recording against the map's by VIO; None for the only recording. Undecided it lowers
    no frame's class: the scale is what all frames share, and windows are compared at the map's."""
    if recording not in scale.recordings or len(scale.recordings) < 2:
        return None
    of_recording = scale.recordings[recording]
    error = float(np.expm1(of_recording.log - scale.log))
    more = "more" if error > 0 else "less"
    reason = f"this session's VIO measures {abs(error):.1%} {more} than all sessions' on average"
    failure = Failure(FailureCause.WRONG_VIO_SCALE, reason, rows, lowers_class=False)
    return evaluate(CheckName.SESSION_SCALE, subject, Quantity(abs(error), of_recording.sd), limit, failure)


def _vertical(subject: Subject, rows: Rows, vertical: Vertical, recording: str, limit_deg: float) -> CheckResult | None:
    """The vertical by the session's recording against the map's; otherwise as for the scale. Where recordings differ
    and nothing tells which is right, each is undecided."""
    if recording not in vertical.recordings or len(vertical.recordings) < 2:
        return None
    of_recording = vertical.recordings[recording]
    others = [other.up_sfm for name, other in vertical.recordings.items() if name != recording]
    ups = np.stack([vertical.up_sfm] if vertical.is_agreed else others)
    tilt_deg = float(np.degrees(direction_angles(ups, of_recording.up_sfm).max()))
    reason = f"this session's gravity points {tilt_deg:.1f} degrees away from the others'"
    failure = Failure(FailureCause.WRONG_VIO_GRAVITY, reason, rows, lowers_class=False)
    estimate = Quantity(tilt_deg, float(np.degrees(of_recording.sd)))
    status = None if vertical.is_agreed else Status.UNDECIDED
    return evaluate(CheckName.SESSION_VERTICAL, subject, estimate, limit_deg, failure, status)


def component_windows(component: Component, frame_sd: tuple[Array, Array]) -> list[SegmentWindow]:
    """The windows of a metric model, each with VIO rigidly fitted to SfM at the common scale; `frame_sd`: standard
    errors of poses in SfM over the rows of the frames table, metres and radians, NaN where unknown."""
    windows: list[SegmentWindow] = []
    for segment in component.segments if component.scale.is_known else []:
        compared, pair = np.flatnonzero(segment.has_both), segment.trajectory_pair
        metric = pair._replace(sfm_T_cam=component.metric_S_sfm.poses(pair.sfm_T_cam))
        sd_m, sd_rad = (np.nan_to_num(sd[segment.rows[compared]]) for sd in frame_sd)
        found = compare_windows(metric, frame_sd=(sd_m, sd_rad))
        windows += [SegmentWindow(**{**vars(w), "inside": compared[w.inside]}, segment=segment) for w in found]
    return windows


def check_window(window: SegmentWindow) -> list[CheckResult]:
    """Both checks of a window: its largest residuals against what VIO may drift by over its path."""
    w, degrees = window, float(np.degrees(1.0))
    return [
        _check_residuals(CheckName.WINDOW_POSITION, w, w.position_m, w.position_sd_m, w.limit_m),
        _check_residuals(CheckName.WINDOW_ROTATION, w, w.rotation, w.rotation_sd, w.limit_rotation, degrees),
    ]


def _check_residuals(
    name: CheckName, window: SegmentWindow, residuals: Array, sds: Array, limit: float, unit: float = 1.0
) -> CheckResult:
    rows, t_ns = window.segment.rows[window.inside], window.segment.t_ns[window.inside]
    wrong, right = beyond(residuals, sds, limit), within(residuals, sds, limit)
    # The frame that decides: beyond the limit for certain, else the one that may be furthest.
    worst = int(np.argmax(residuals + SIGMAS * sds * (-1.0 if wrong.any() else 1.0)))
    subject = Subject(len(rows), window.segment.session_id, window.segment.component, t_ns)
    estimate = Quantity(unit * float(residuals[worst]), unit * float(sds[worst]))
    failure = Failure(FailureCause.VIO_INCONSISTENT, f"{int(window.wrong.sum())} of {len(rows)} frames: {_APART}")
    result = evaluate(name, subject, estimate, unit * limit, failure)
    return replace(result, exclusions=(Exclusion(rows[wrong], _APART),), undecided_rows=rows[~wrong & ~right])


def max_residuals(count: int, windows: Sequence[SegmentWindow]) -> tuple[Array, Array]:
    """The largest residual over its windows of each row of the frames table, metres and radians (count,), NaN where it
    is in none."""
    metres, radians = np.full(count, np.nan), np.full(count, np.nan)
    for window in windows:
        rows = window.segment.rows[window.inside]
        metres[rows] = np.fmax(metres[rows], window.position_m)
        radians[rows] = np.fmax(radians[rows], window.rotation)
    return metres, radians
