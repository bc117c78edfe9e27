"""SfM's models in the frame of reference poses, where no frame has VIO, and the checks of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.components import check_standard_errors, missing_scale
from groundwalk.alignment.checks.results import CheckResult, Exclusion, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.checks.sessions import focal_length_result
from groundwalk.alignment.components import Component, ModelSegments, PlacedComponent
from groundwalk.alignment.inputs import AlignInputs
from groundwalk.alignment.map_frame import NO_SCALE, MapScale, Vertical
from groundwalk.alignment.reference.diagnosis import Limits, explain
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.settings import AlignSettings
from groundwalk.consistency.decisions import Status
from groundwalk.geometry import GeometryError
from groundwalk.geometry.pose_similarity import PoseSimilarity, fit_similar_poses
from groundwalk.store import UserError
from groundwalk.store.choices import CheckName, FailureCause


@dataclass(frozen=True)
class ReferenceFit:
    """One SfM model fitted to the reference: `rows` (n,) of the frames table that were compared, residuals there in the
    reference's unit and radians, the limits, and which of the residuals are beyond them (n,)."""

    placed: PlacedComponent
    fit: PoseSimilarity
    rows: np.ndarray
    limits: Limits
    is_away: np.ndarray


def limits_of(reference: Reference, settings: AlignSettings) -> Limits:
    """How far frames may be from their reference poses."""
    return Limits(
        fraction=settings.max_reference_error_fraction,
        constant=settings.max_reference_error_m if reference.is_metric else 0.0,
        rotation=float(np.radians(settings.max_reference_error_deg)),
        min_consistent=settings.min_consistent_fraction,
    )


def fit_component(index: int, model: ModelSegments, reference: Reference, settings: AlignSettings) -> ReferenceFit:
    """Fit a model to the reference by a robust similarity; GeometryError where its poses don't determine one."""
    rows = np.concatenate([s.rows for s in model.segments])
    sfm_T_cam = np.concatenate([s.sfm_T_cam for s in model.segments])
    both = np.isfinite(sfm_T_cam[:, 0, 0]) & np.isfinite(reference.map_T_cam[rows, 0, 0])
    fit = fit_similar_poses(reference.map_T_cam[rows[both]], sfm_T_cam[both])
    component = Component(
        index=index,
        model_id=model.model_id,
        segments=model.segments,
        pieces=model.pieces,
        scale=MapScale(float(np.log(fit.a_S_b.scale)), fit.scale_sd, {}, reference=reference.scale_source),
        vertical=Vertical(fit.a_S_b.rotation[1], fit.turn_sd, {}, reference.vertical_source),
        vio_scale=NO_SCALE,
    )
    limits = limits_of(reference, settings)
    is_away = (fit.position > limits.position(reference.extent)) | (fit.rotation > limits.rotation)
    return ReferenceFit(PlacedComponent(component, fit.a_S_b), fit, rows[both], limits, is_away)


def place_on_reference(
    models: Sequence[ModelSegments], inputs: AlignInputs, reference: Reference, settings: AlignSettings
) -> tuple[list[ReferenceFit], list[CheckResult]]:
    """Each model in the reference's frame by its own fit, and the checks of its sessions against it. Raises UserError
    where the largest model can't be fitted."""
    fits, results = list[ReferenceFit](), list[CheckResult]()
    for index, model in enumerate(models):
        try:
            fit = fit_component(index, model, reference, settings)
        except GeometryError as error:
            results.append(_not_placed(index, model, error))
            continue
        fits.append(fit)
        results += check_standard_errors(fit.placed.component, settings)
        results += check_session_references(fit, inputs.frames, reference, settings)
        results += _check_focal_lengths(index, model, inputs, settings)
    return fits, results


def _not_placed(index: int, model: ModelSegments, error: GeometryError) -> CheckResult:
    if index == 0:
        raise UserError(
            "the largest SfM model can't be aligned to the reference poses",
            where="frames that have both an SfM and a reference pose",
            expected="3 or more, in different places",
            found=error,
            do="import more frames of the data set",
        ) from None
    reason = f"its SfM model can't be aligned to the reference poses: {error}"
    return missing_scale(index, model, FailureCause.DISCONNECTED_SESSION, reason)


def check_session_references(
    fit: ReferenceFit, frames: pd.DataFrame, reference: Reference, settings: AlignSettings
) -> list[CheckResult]:
    """Check that each session's frames lie where the reference has them. Those that don't get no ground truth; of a
    session none does, where too many don't. The fraction is a count: it has no standard error."""
    results, component = [], fit.placed.component
    for session_id in dict.fromkeys(s.session_id for s in component.segments):
        rows = np.concatenate([s.rows[s.registered] for s in component.segments if s.session_id == session_id])
        of_session = np.isin(fit.rows, rows)
        compared, away = int(of_session.sum()), fit.rows[of_session & fit.is_away]
        if not compared:
            continue
        position, degrees = np.median(fit.fit.position[of_session]), np.median(np.degrees(fit.fit.rotation[of_session]))
        subject, fraction = Subject(compared, session_id, component.index), Quantity(len(away) / compared)
        limit = 1 - settings.min_consistent_fraction
        reason = (
            f"{len(away)} of {compared} frames of {session_id} are away from their reference poses, by {position:.3g} "
            f"and {degrees:.1f} degrees (medians)"
        )
        if len(away) / compared > limit:
            reason = f"{reason}: {_explain(fit, component, frames, reference, of_session)}"
        failure = Failure(cause=FailureCause.REFERENCE_INCONSISTENT, reason=reason, rows=rows)
        result = evaluate(CheckName.SESSION_REFERENCE, subject, fraction, limit, failure)
        if result.status is Status.PASSED:
            result = replace(result, exclusions=(Exclusion(away, "poses in SfM and reference inconsistent"),))
        results.append(result)
    return results


def _explain(
    fit: ReferenceFit, component: Component, frames: pd.DataFrame, reference: Reference, of_session: np.ndarray
) -> str:
    """What it looks like that a session's compared frames (n,) don't agree."""
    rows = fit.rows[of_session]
    rows = rows[np.argsort(frames["t_ns"].to_numpy()[rows], kind="stable")]
    sfm_T_cam = np.full_like(reference.map_T_cam, np.nan)
    for segment in component.segments:
        sfm_T_cam[segment.rows] = segment.sfm_T_cam
    ids = frames["frame_id"].to_numpy(str)[rows]
    return explain(reference.map_T_cam[rows], sfm_T_cam[rows], ids, fit.limits)


def _check_focal_lengths(
    index: int, model: ModelSegments, inputs: AlignInputs, settings: AlignSettings
) -> list[CheckResult]:
    results = []
    for session_id in dict.fromkeys(s.session_id for s in model.segments):
        rows = np.concatenate([s.rows[s.registered] for s in model.segments if s.session_id == session_id])
        focal = inputs.sfm.focal(model.model_id, session_id)
        if focal is not None and len(rows):
            subject = Subject(len(rows), session_id, index)
            results.append(focal_length_result(subject, rows, focal, settings.max_focal_error))
    return results
