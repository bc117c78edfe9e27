"""Scale and vertical of each SfM model, where each lies in the map, and all checks before ground truth is given out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.components import check_links, check_standard_errors, missing_scale
from groundwalk.alignment.checks.registration import check_registration
from groundwalk.alignment.checks.results import (
    CheckResult,
    exclusion_reasons,
    main_failure,
    undecided_reasons,
    with_status,
)
from groundwalk.alignment.checks.sessions import check_sessions
from groundwalk.alignment.checks.uncertain_frames import check_uncertain_frames
from groundwalk.alignment.checks.windows import SegmentWindow, check_window, component_windows, max_residuals
from groundwalk.alignment.components import Component, ModelSegments, PlacedComponent
from groundwalk.alignment.inputs import AlignInputs
from groundwalk.alignment.map_frame import common_scale, common_vertical
from groundwalk.alignment.quality import sfm_covariances
from groundwalk.alignment.reference.placement import limits_of, place_on_reference
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.rulers.scale_check import RulerCheck, check_rulers, scale_by_rulers
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.uncertainty import covariance_in_map, largest_sd
from groundwalk.alignment.vio_links import place_components
from groundwalk.consistency.decisions import Status
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.choices import FailureCause
from groundwalk.store.hints import setting_of

# A frame of class A or B is within these of its true pose with 95 %: a reference pose further away confirms neither.
_CONFIRMED_M, _CONFIRMED_RAD = 0.25, float(np.radians(2.0))


@dataclass(frozen=True, kw_only=True)
class Examination:
    """The models that are metric and upright, where each lies in the map, and all checks. Arrays are over the rows of
    the frames table: `registered`, `exclusion` (why a frame gets no ground truth, empty where it does), `problem` (why
    one that does is of class C at best), the largest residuals of its windows (or those against the reference, where
    that gives the map) in metres and radians, NaN in none.
    `reference_limit` is what those against a reference may be."""

    components: list[Component]
    placed: list[PlacedComponent]
    windows: list[SegmentWindow]
    checks: list[CheckResult]
    rulers: list[RulerCheck]
    registered: np.ndarray
    exclusion: np.ndarray
    problem: np.ndarray
    residual_m: Array
    residual_rad: Array
    reference: Reference | None
    reference_limit: tuple[float, float] | None = None

    @property
    def has_ground_truth(self) -> np.ndarray:
        """(N,) frames with ground truth."""
        return self.registered & (self.exclusion == "")

    def where(self, mask: np.ndarray) -> "Examination":
        """The rows of the frames table for which `mask` (N,) holds, numbered from 0; windows and checks stay as they
        are."""
        row_of = np.cumsum(mask) - 1

        def part(segments: list[Segment]) -> list[Segment]:
            return [s.where(mask[s.rows]).renumbered(row_of) for s in segments if mask[s.rows].any()]

        components = {c.index: replace(c, segments=part(c.segments), pieces=part(c.pieces)) for c in self.components}
        placed = [replace(p, component=components[p.component.index]) for p in self.placed]
        arrays = ("registered", "exclusion", "problem", "residual_m", "residual_rad")
        return replace(
            self,
            components=[c for c in components.values() if c.segments],
            placed=[p for p in placed if p.component.segments],
            reference=None if self.reference is None else self.reference.where(mask),
            **{name: getattr(self, name)[mask] for name in arrays},
        )


def examine(inputs: AlignInputs, settings: AlignSettings) -> Examination:
    """Check SfM's models against VIO, or a reference where no frame has VIO, and put those that pass into one map.

    Raises UserError where there is nothing to compare; `refusal` says whether there is ground truth at all.
    """
    if not inputs.registered.any():
        raise UserError(
            "nothing to align: SfM registered no frame",
            where="sfm.images",
            found=f"0 of {len(inputs.frames)} frames registered",
            do="look at the sfm recording and its pairs table",
        )
    models = inputs.models(settings)
    if inputs.reference is not None and inputs.reference.gives_map:
        return _examine_by_reference(inputs, models, inputs.reference, settings)
    return _examine_by_vio(inputs, models, settings)


def _examine_by_vio(inputs: AlignInputs, models: Sequence[ModelSegments], settings: AlignSettings) -> Examination:
    registered, count = inputs.registered, len(inputs.frames)
    not_registered = inputs.not_registered
    checks = check_registration(inputs.frames, registered, inputs.recordings, settings)
    of_model: dict[str, Component | None] = {}
    for index, model in enumerate(models):
        component, results = _component(index, model, inputs, settings)
        of_model[model.model_id] = component
        checks += results + ([] if component is None else check_sessions(component, inputs.sfm, settings))
    components = [component for component in of_model.values() if component is not None]
    rulers = _check_rulers(inputs, of_model, settings)
    windows = _windows(components, inputs, settings)
    checks += [ruler.result for ruler in rulers]
    checks += [result for window in windows for result in check_window(window)]
    residual_m, residual_rad = max_residuals(count, windows)
    not_compared = np.where(np.isfinite(residual_m), "", "not compared with VIO").astype(object)
    # Uncertain frames and links are judged by the frames that the checks before leave.
    used = exclusion_reasons(checks, not_registered) == ""
    checks += check_uncertain_frames(components, inputs, used, not_compared, settings)
    used = exclusion_reasons(checks, not_registered) == ""
    placed, results = _place(components, used, settings)
    checks += results
    return Examination(
        components=components,
        placed=placed,
        windows=windows,
        checks=checks,
        rulers=rulers,
        registered=registered,
        exclusion=exclusion_reasons(checks, not_registered),
        problem=_problems(not_compared, checks, components),
        residual_m=residual_m,
        residual_rad=residual_rad,
        reference=inputs.reference,
    )


def _examine_by_reference(
    inputs: AlignInputs, models: Sequence[ModelSegments], reference: Reference, settings: AlignSettings
) -> Examination:
    """There are no windows: residuals are those against the reference. A ruler never sets the scale: lengths are the
    reference's."""
    registered, count = inputs.registered, len(inputs.frames)
    checks = check_registration(inputs.frames, registered, inputs.recordings, settings)
    limits = limits_of(reference, settings)
    fits, results = place_on_reference(models, inputs, reference, settings)
    placed = [fit.placed for fit in fits]
    components = [p.component for p in placed]
    of_model = {model.model_id: None for model in models} | {c.model_id: c for c in components}
    rulers = _check_rulers(inputs, of_model, settings)
    checks += results + [ruler.result for ruler in rulers]
    residual_m, residual_rad = np.full((2, count), np.nan)
    for fit in fits:
        residual_m[fit.rows], residual_rad[fit.rows] = fit.fit.position, fit.fit.rotation
    is_confirmed = (residual_m <= _CONFIRMED_M) & (residual_rad <= _CONFIRMED_RAD)
    away = f"more than {_CONFIRMED_M} m or {np.degrees(_CONFIRMED_RAD):.0f} degrees from its reference pose"
    problem = np.where(np.isfinite(residual_m), np.where(is_confirmed, "", away), "no reference pose").astype(object)
    return Examination(
        components=components,
        placed=placed,
        windows=[],
        checks=checks,
        rulers=rulers,
        registered=registered,
        exclusion=exclusion_reasons(checks, inputs.not_registered),
        problem=_problems(problem, checks, components),
        residual_m=residual_m,
        residual_rad=residual_rad,
        reference=reference,
        reference_limit=(limits.position(reference.extent), limits.rotation),
    )


def _component(
    index: int, model: ModelSegments, inputs: AlignInputs, settings: AlignSettings
) -> tuple[Component | None, list[CheckResult]]:
    """A model's scale and vertical, and the checks of them; None where it has no scale and isn't the first: no VIO can
    place it then. The first may keep SfM's unit."""
    try:
        vio_scale = common_scale(
            model.pieces, step_m=settings.step_m, step_sd=settings.step_scale_sd, phone_sd=settings.phone_scale_sd
        )
    except GeometryError as error:
        reason = f"frames at one place in SfM are apart in VIO: {error}"
        return None, [missing_scale(index, model, FailureCause.VIO_INCONSISTENT, reason)]
    rulers = inputs.rulers_of(model.model_id)
    scale = scale_by_rulers(vio_scale, rulers, settings.max_ruler_size_error) or vio_scale
    vertical = common_vertical(
        model.segments,
        phone_sd=float(np.radians(settings.phone_tilt_sd_deg)),
        max_tilt=float(np.radians(settings.max_session_tilt_deg)),
        tested=inputs.gravity_tested,
    )
    if index and not scale.is_known:
        reason = "its SfM model has no metric scale: VIO hardly moves in it"
        return None, [missing_scale(index, model, FailureCause.DISCONNECTED_SESSION, reason)]
    component = Component(
        index=index,
        model_id=model.model_id,
        segments=model.segments,
        pieces=model.pieces,
        scale=scale,
        vertical=vertical,
        vio_scale=vio_scale,
    )
    return component, check_standard_errors(component, settings)


def _check_rulers(
    inputs: AlignInputs, of_model: dict[str, Component | None], settings: AlignSettings
) -> list[RulerCheck]:
    """Checks of all rulers, model by model; those that no model sees last."""
    limit, elsewhere = settings.max_ruler_size_error, [r for r in inputs.rulers if r.model_id not in of_model]
    checks = [c for name, part in of_model.items() for c in check_rulers(part, inputs.rulers_of(name), limit)]
    return checks + check_rulers(None, elsewhere, limit)


def _windows(components: list[Component], inputs: AlignInputs, settings: AlignSettings) -> list[SegmentWindow]:
    covariance, windows = sfm_covariances(inputs.sfm.images["covariance"]), []
    for component in components:
        frame_sd = largest_sd(covariance_in_map(covariance, component.metric_S_sfm))
        windows += component_windows(component, settings, frame_sd)
    return windows


def _place(
    components: list[Component], used: np.ndarray, settings: AlignSettings
) -> tuple[list[PlacedComponent], list[CheckResult]]:
    """One map of all models with frames in use, and the checks of their links."""
    if not used.any():
        return [], []
    in_use = [c for c in components if any(used[s.rows].any() for s in c.segments)]
    placed, unlinked = place_components(in_use, used, settings)
    return placed, check_links(placed, unlinked, settings)


def _problems(problem: np.ndarray, checks: Sequence[CheckResult], components: list[Component]) -> np.ndarray:
    """Why frames (N,) are of class C at best: an undecided check, else `problem` (N,); in a model without scale all
    are, as limits are in metres."""
    undecided = undecided_reasons(checks, len(problem))
    problem = np.where(undecided == "", problem, undecided)
    for component in (c for c in components if not c.scale.is_known):
        for segment in component.segments:
            problem[segment.rows] = "the map has no metric scale"
    return problem


def refusal(examination: Examination, frames: pd.DataFrame, settings: AlignSettings) -> UserError | None:
    """Why there is no ground truth at all, if there isn't; counted over the frames of the dataset."""
    dataset = ~frames["support"].to_numpy(bool)
    registered, passed = examination.registered[dataset], examination.has_ground_truth[dataset]
    registered_fraction = registered.mean()
    if registered_fraction < settings.min_registered_fraction:
        return UserError(
            "SfM registered too few frames for ground truth",
            where="sfm.images",
            expected=f"at least {settings.min_registered_fraction:.0%} of them",
            found=f"{registered.sum()} of {len(registered)} ({registered_fraction:.0%})",
            do=examination.checks[0].advice,
        )
    fraction, main = passed.sum() / registered.sum(), main_failure(examination.checks)
    if main is None or (fraction >= settings.min_consistent_fraction and passed.any()):
        return None
    failed = len(with_status(examination.checks, Status.FAILED))
    return UserError(
        f"the SfM model fails its consistency checks: {main.cause}",
        where=_place_of(main, examination.windows, frames),
        expected=f"ground truth for at least {settings.min_consistent_fraction:.0%} of the registered frames",
        found=f"{passed.sum()} of {registered.sum()} ({fraction:.0%}); {failed} of {len(examination.checks)} checks "
        f"failed; {main.reason}",
        do=f"{main.advice}; or lower {setting_of('align', 'min_consistent_fraction')}" if passed.any() else main.advice,
    )


def _place_of(check: CheckResult, windows: Sequence[SegmentWindow], frames: pd.DataFrame) -> str:
    """Where a check failed: its session or model, or the frames of the worst window."""
    if check.subject.t_ns is not None:
        worst = max(windows, key=lambda w: float(w.position_m.max() / w.limit_m))
        ids = frames["frame_id"].to_numpy(str)[worst.segment.rows[worst.inside]]
        return f"worst from {ids[0]} to {ids[-1]}"
    if check.subject.session_id:
        return f"session {check.subject.session_id}"
    return f"model {check.subject.component}"
