"""Frames with uncertain poses in SfM (class C) must move as VIO does."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Rows, Subject, evaluate
from groundwalk.alignment.components import Component
from groundwalk.alignment.quality import grade_frames
from groundwalk.alignment.segments import Segment, registered_rows, sessions_of
from groundwalk.alignment.uncertainty import covariance_in_map
from groundwalk.consistency.decisions import SIGMAS
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, relative
from groundwalk.store.choices import CheckName, FailureCause, QualityClass

# Over 5 m the 95 % bounds of class B, 0.3 degrees, are 7 cm, and VIO drifts as far: 0.018 of the path is 9 cm.
_STEP_M, _MAX_DEVIATION = 5.0, 0.018
# VIO's drift between certain frames is this quantile of its deviations, of at least so many steps.
_DRIFT_QUANTILE, _MIN_STEPS = 0.99, 20
_REASON = (
    f"uncertain pose in SfM: its motion differs from VIO's by more than {_MAX_DEVIATION:.1%} of the path, and by more "
    "than that of frames with certain poses"
)


def check_uncertain_frames(
    components: Sequence[Component],
    frames: pd.DataFrame,
    images: pd.DataFrame,
    covariance: Array,
    used: np.ndarray,
    problem: np.ndarray,
    min_consistent: float,
) -> list[CheckResult]:
    """Each session's uncertain frames against VIO, by import's frames and SfM's images in their order, with covariances
    (N, 6, 6) in SfM's frame. `used` (N,): frames that have ground truth so far; `problem` (N,): why a frame is of class
    C for another reason.

    A frame of class A or B needs no confirmation. Nor does one whose motion over 5 m keeps two standard deviations
    within the limit: far from the middle of a long walk poses are uncertain, and motions aren't. Another one of class C
    must move as VIO does, within a tighter limit than elsewhere, or as the session's certain frames do; where most of a
    session's don't, none of them gets ground truth. That is a fault of the session where it excludes more frames than
    `min_consistent` leaves. The fraction is a count: it has no standard error.
    """
    results = []
    motion_sd = images["motion_sd"].to_numpy(float, na_value=np.nan)
    has_certain_motion = (SIGMAS * motion_sd <= _MAX_DEVIATION) & (problem == "")
    for component in (c for c in components if c.scale.is_known):
        grades = grade_frames(frames, images, covariance_in_map(covariance, component.metric_S_sfm), problem)
        is_certain = has_certain_motion | [grade.quality is not QualityClass.C for grade in grades]
        for session_id in sessions_of(component.segments):
            segments = [s.where(s.has_both & used[s.rows]) for s in component.segments if s.session_id == session_id]
            compared = [s for s in segments if len(s.rows) > 1]
            rows = np.concatenate([np.empty(0, np.intp), *(s.rows for s in compared)])
            uncertain = rows[~is_certain[rows]]
            if len(uncertain):
                inconsistent = np.concatenate([_inconsistent(s, component.metric_S_sfm, is_certain) for s in compared])
                excluded = inconsistent if len(inconsistent) <= len(uncertain) / 2 else uncertain
                subject = Subject(len(registered_rows(component.segments, session_id)), session_id, component.index)
                share, limit = Quantity(len(excluded) / subject.frames), 1 - min_consistent
                of_all = f"{len(inconsistent)} of {len(uncertain)} uncertain frames"
                reason = f"{of_all}: pose in SfM inconsistent with VIO"
                failure = Failure(cause=FailureCause.VIO_INCONSISTENT, reason=reason)
                result = evaluate(CheckName.SESSION_UNCERTAIN, subject, share, limit, failure)
                results.append(replace(result, exclusions=(Exclusion(excluded, _REASON),)))
    return results


def _inconsistent(segment: Segment, metric_S_sfm: Sim3, is_certain: np.ndarray) -> Rows:
    """Rows of a segment's frames, all with both poses, that are uncertain and contradicted by VIO: over a path of 5 to
    15 m, relative positions differ by more than the allowed fraction of it, and by more than those of all but a few
    steps between certain frames: VIO itself may drift by that much here.

    The worst frame is excluded first, until no step with an uncertain frame is contradicted.
    """
    along, certain = segment.travelled_m, is_certain[segment.rows]
    excluded = np.zeros(len(along), dtype=bool)
    path_m = along[None] - along[:, None]
    first, last = np.nonzero((path_m >= _STEP_M) & (path_m <= 3 * _STEP_M))
    sfm, vio = metric_S_sfm.poses(segment.sfm_T_cam), segment.vio_T_cam
    difference = relative(sfm[first], sfm[last])[:, :3, 3] - relative(vio[first], vio[last])[:, :3, 3]
    deviation = np.linalg.norm(difference, axis=1) / path_m[first, last]
    is_between_certain = certain[first] & certain[last]
    limit = _MAX_DEVIATION
    if np.count_nonzero(is_between_certain) >= _MIN_STEPS:
        limit = max(limit, float(np.quantile(deviation[is_between_certain], _DRIFT_QUANTILE)))
    is_contradicted = (deviation > limit) & ~is_between_certain
    while is_contradicted.any():
        a, b, by = first[is_contradicted], last[is_contradicted], deviation[is_contradicted]
        contradictions = np.bincount(a, by, len(along)) + np.bincount(b, by, len(along))
        worst = int(np.argmax(np.where(certain, 0.0, contradictions)))
        excluded[worst] = True
        is_contradicted &= (first != worst) & (last != worst)
    return segment.rows[excluded]
