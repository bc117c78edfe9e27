"""Frames with uncertain poses in SfM (class C) must move as VIO does."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Rows, Subject, evaluate
from groundwalk.alignment.components import Component
from groundwalk.alignment.inputs import AlignInputs
from groundwalk.alignment.quality import grade_frames, sfm_covariances
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.uncertainty import covariance_in_map
from groundwalk.consistency.decisions import SIGMAS
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import relative
from groundwalk.store.choices import CheckName, FailureCause, QualityClass

# VIO's drift between certain frames is this quantile of its deviations, of at least so many steps.
_DRIFT_QUANTILE, _MIN_STEPS = 0.99, 20


class _UncertainRows(NamedTuple):
    """Rows of a session's uncertain frames, and those of them that VIO contradicts."""

    uncertain: Rows
    inconsistent: Rows


def check_uncertain_frames(
    components: list[Component], inputs: AlignInputs, used: np.ndarray, problem: np.ndarray, settings: AlignSettings
) -> list[CheckResult]:
    """Each session's uncertain frames against VIO. `used` (N,): frames that have ground truth so far; `problem` (N,):
    why a frame is of class C for another reason.

    A frame of class A or B needs no confirmation: its 95 % bounds of 0.3 degrees are 7 cm after 5 m, and VIO drifts as
    far. Nor does one whose motion over 5 m keeps two standard deviations within that limit: far from the middle of a
    long walk poses are uncertain, and motions aren't. Another one of class C must move as VIO does, within a tighter
    limit than elsewhere, or as the session's certain frames do; where most of a session's don't, none of them gets
    ground truth. That is a fault of the session where it excludes too many frames. The fraction is a count: it has no
    standard error.
    """
    covariance, results = sfm_covariances(inputs.sfm.images["covariance"]), []
    motion_sd = inputs.sfm.images["motion_sd"].to_numpy(float, na_value=np.nan)
    has_certain_motion = (SIGMAS * motion_sd <= settings.max_uncertain_deviation) & (problem == "")
    for component in (c for c in components if c.scale.is_known):
        in_map = covariance_in_map(covariance, component.metric_S_sfm)
        grades = grade_frames(inputs.frames, inputs.sfm.images, in_map, problem, settings)
        is_certain = has_certain_motion | [grade.quality is not QualityClass.C for grade in grades]
        for session_id in dict.fromkeys(s.session_id for s in component.segments):
            segments = [s for s in component.segments if s.session_id == session_id]
            pieces = [p for p in component.pieces if p.session_id == session_id]
            rows = _uncertain_rows(pieces, component.metric_S_sfm, is_certain, used, settings)
            if len(rows.uncertain):
                registered = sum(int(s.registered.sum()) for s in segments)
                results.append(_check(rows, Subject(registered, session_id, component.index), settings))
    return results


def _check(rows: _UncertainRows, subject: Subject, settings: AlignSettings) -> CheckResult:
    count, total = len(rows.inconsistent), len(rows.uncertain)
    excluded = rows.inconsistent if count <= total / 2 else rows.uncertain
    failure = Failure(
        cause=FailureCause.VIO_INCONSISTENT,
        reason=f"{count} of {total} uncertain frames: pose in SfM inconsistent with VIO",
    )
    fraction, limit = Quantity(len(excluded) / subject.frames), 1 - settings.min_consistent_fraction
    result = evaluate(CheckName.SESSION_UNCERTAIN, subject, fraction, limit, failure)
    reason = (
        "uncertain pose in SfM: its motion differs from VIO's by more than "
        f"{settings.max_uncertain_deviation:.1%} of the path, and by more than that of frames with certain poses"
    )
    return replace(result, exclusions=(Exclusion(excluded, reason),))


def _uncertain_rows(
    segments: list[Segment], metric_S_sfm: Sim3, is_certain: np.ndarray, used: np.ndarray, settings: AlignSettings
) -> _UncertainRows:
    uncertain, inconsistent = [np.empty(0, np.intp)], [np.empty(0, np.intp)]
    for segment in segments:
        part = segment.where(segment.has_both & used[segment.rows])
        if len(part.rows) > 1:
            certain = is_certain[part.rows]
            uncertain.append(part.rows[~certain])
            inconsistent.append(part.rows[_inconsistent(part, metric_S_sfm, certain, settings)])
    return _UncertainRows(np.concatenate(uncertain), np.concatenate(inconsistent))


def _inconsistent(part: Segment, metric_S_sfm: Sim3, is_certain: np.ndarray, settings: AlignSettings) -> np.ndarray:
    """Which frames (N,) with both poses are uncertain and contradicted by VIO: over a path of `uncertain_step_m` to
    three times that, relative positions differ by more than the allowed fraction of it, and by more than those of all
    but a few steps between certain frames: VIO itself may drift by that much here.

    The worst frame is excluded first, until no step with an uncertain frame is contradicted.
    """
    excluded = np.zeros(len(is_certain), dtype=bool)
    if is_certain.all():
        return excluded
    along, step_m = part.travelled_m, settings.uncertain_step_m
    first, last = np.nonzero((along[None] - along[:, None] >= step_m) & (along[None] - along[:, None] <= 3 * step_m))
    sfm, vio = metric_S_sfm.poses(part.sfm_T_cam), part.vio_T_cam
    difference = relative(sfm[first], sfm[last])[:, :3, 3] - relative(vio[first], vio[last])[:, :3, 3]
    deviation = np.linalg.norm(difference, axis=1) / (along[last] - along[first])
    is_between_certain = is_certain[first] & is_certain[last]
    limit = settings.max_uncertain_deviation
    if np.count_nonzero(is_between_certain) >= _MIN_STEPS:
        limit = max(limit, float(np.quantile(deviation[is_between_certain], _DRIFT_QUANTILE)))
    is_contradicted = (deviation > limit) & ~is_between_certain
    while is_contradicted.any():
        a, b, by = first[is_contradicted], last[is_contradicted], deviation[is_contradicted]
        contradictions = np.bincount(a, by, len(along)) + np.bincount(b, by, len(along))
        worst = int(np.argmax(np.where(is_certain, 0.0, contradictions)))
        excluded[worst] = True
        is_contradicted &= (first != worst) & (last != worst)
    return excluded
