"""SfM's models in the frame of reference poses, where no frame has VIO, and the checks of their sessions."""

from dataclasses import replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import NO_SCALE, Component, MapScale, PlacedComponent, Vertical
from groundwalk.alignment.reference.diagnosis import Limits, explain
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.segments import Segment, registered_rows, sessions_of
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.pose_similarity import PoseSimilarity, fit_similar_poses
from groundwalk.store.choices import CheckName, FailureCause, ScaleSource, VerticalSource

# Real references, by depth or other SfM, are off by some per cent of a metre in a room and by more in a street.
_MAX_ERROR_OF_EXTENT = 0.01


def limits_of(reference: Reference, settings: AlignSettings) -> Limits:
    """How far frames may be from their reference poses."""
    constant = settings.max_reference_error_m if reference.is_metric else 0.0
    rotation = float(np.radians(settings.max_reference_error_deg))
    return Limits(_MAX_ERROR_OF_EXTENT, constant, rotation, settings.min_consistent_fraction)


def fit_component(
    index: int, model_id: str, segments: list[Segment], reference: Reference
) -> tuple[PlacedComponent, np.ndarray, PoseSimilarity]:
    """A model put onto the reference by a robust similarity, the rows (n,) of the frames table that were compared, and
    the fit with their residuals; GeometryError where its poses don't determine one."""
    rows = np.concatenate([s.rows for s in segments])
    sfm_T_cam = np.concatenate([s.sfm_T_cam for s in segments])
    both = np.isfinite(sfm_T_cam[:, 0, 0]) & np.isfinite(reference.map_T_cam[rows, 0, 0])
    fit = fit_similar_poses(reference.map_T_cam[rows[both]], sfm_T_cam[both])
    scale_by = ScaleSource.REFERENCE if reference.is_metric else ScaleSource.REFERENCE_UNIT_UNKNOWN
    vertical_by = VerticalSource.REFERENCE if reference.is_up_known else VerticalSource.REFERENCE_UP_UNKNOWN
    scale = MapScale(float(np.log(fit.a_S_b.scale)), fit.scale_sd, {}, reference=scale_by)
    vertical = Vertical(fit.a_S_b.rotation[1], fit.turn_sd, {}, vertical_by)
    component = Component(
        index=index, model_id=model_id, segments=segments, scale=scale, vertical=vertical, vio_scale=NO_SCALE
    )
    return PlacedComponent(component, fit.a_S_b), rows[both], fit


def check_session_references(
    component: Component,
    compared: np.ndarray,
    fit: PoseSimilarity,
    frames: pd.DataFrame,
    reference: Reference,
    limits: Limits,
) -> list[CheckResult]:
    """Check that each session's frames lie where the reference has them, by a model's fit and the rows (n,) of the
    frames table that it compared. Those that don't get no ground truth; of a session none does, where too many don't.
    The fraction is a count: it has no standard error."""
    results = []
    is_away = (fit.position > limits.position(reference.extent)) | (fit.rotation > limits.rotation)
    for session_id in sessions_of(component.segments):
        rows = registered_rows(component.segments, session_id)
        of_session = np.isin(compared, rows)
        count, away = int(of_session.sum()), compared[of_session & is_away]
        if not count:
            continue
        reason, limit = "", 1 - limits.min_consistent
        if len(away) / count > limit:
            off = of_session & is_away
            position, degrees = np.median(fit.position[off]), np.median(np.degrees(fit.rotation[off]))
            unit = "m" if reference.is_metric else "of its unit"
            at = compared[of_session]
            at = at[np.argsort(frames["t_ns"].to_numpy()[at], kind="stable")]
            sfm_T_cam = np.full_like(reference.map_T_cam, np.nan)
            for segment in component.segments:
                sfm_T_cam[segment.rows] = segment.sfm_T_cam
            ids = frames["frame_id"].to_numpy(str)[at]
            reason = (
                f"{len(away)} of {count} frames of {session_id} are away from their reference poses, by {position:.3g} "
                f"{unit} and {degrees:.1f} degrees (medians of these): "
                f"{explain(reference.map_T_cam[at], sfm_T_cam[at], ids, limits)}"
            )
        failure = Failure(cause=FailureCause.REFERENCE_INCONSISTENT, reason=reason, rows=rows)
        subject, fraction = Subject(count, session_id, component.index), Quantity(len(away) / count)
        result = evaluate(CheckName.SESSION_REFERENCE, subject, fraction, limit, failure)
        if result.status is Status.PASSED:
            result = replace(result, exclusions=(Exclusion(away, "poses in SfM and reference inconsistent"),))
        results.append(result)
    return results
