"""Scale and vertical of each SfM model, where each lies in the map, and all checks before ground truth is given out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.definitions import DEFINITIONS
from groundwalk.alignment.checks.models import check_links, check_registration, check_standard_errors, missing_scale
from groundwalk.alignment.checks.results import CheckResult, Subject, exclusion_reasons, main_failure, undecided_reasons
from groundwalk.alignment.checks.sessions import (
    check_focal_length,
    check_sessions,
    check_window,
    component_windows,
    max_residuals,
)
from groundwalk.alignment.components import NOT_GIVEN, Component, GivenFrame, PlacedComponent
from groundwalk.alignment.map_frame import common_scale, common_vertical
from groundwalk.alignment.reference.placement import check_session_references, fit_component, limits_of
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.rulers.measurement import RulerMeasurement
from groundwalk.alignment.rulers.scale_check import scale_by_rulers
from groundwalk.alignment.segments import Segment, SegmentWindow, cut_segments, registered_rows, sessions_of
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables, covariances
from groundwalk.alignment.uncertainty import covariance_in_map, largest_sd
from groundwalk.alignment.vio_links import place_components
from groundwalk.consistency.decisions import Status
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.choices import CheckName, FailureCause
from groundwalk.store.hints import setting_of

# A frame of class A or B is within these of its true pose with 95 %: a reference pose further away confirms neither.
_CONFIRMED_M, _CONFIRMED_RAD = 0.25, float(np.radians(2.0))
# Where more of the frames than this contradict a reference, the others may agree with it by chance.
_MAX_CONTRADICTING = 0.25
Models = list[tuple[str, list[Segment]]]  # by their ids, the largest first


@dataclass(frozen=True, kw_only=True)
class FrameVerdicts:
    """What the checks say of frames (N,): whether SfM has a pose, why a frame gets no ground truth (`exclusion`, empty
    where it does), why one that does is of class C at best (`problem`), and its largest residuals against VIO (or the
    reference that gives the map), metres and radians, NaN where there are none."""

    registered: np.ndarray
    exclusion: np.ndarray
    problem: np.ndarray
    residual_m: Array
    residual_rad: Array

    @property
    def has_ground_truth(self) -> np.ndarray:
        """(N,) frames with ground truth."""
        return self.registered & (self.exclusion == "")


@dataclass(frozen=True, kw_only=True)
class CheckedMap:
    """The models that are metric and upright, where each lies in the map, all checks, and what they say of the rows of
    the frames table. `windows` are what was compared with VIO; `reference_limit` is how far frames may be from the
    reference poses that give the map, in its unit and radians, None where VIO gives it."""

    components: list[Component]
    placed: list[PlacedComponent]
    checks: list[CheckResult]
    frames: FrameVerdicts
    windows: Sequence[SegmentWindow] = ()
    reference_limit: tuple[float, float] | None = None

    def where(self, mask: np.ndarray) -> "CheckedMap":
        """Of the rows of the frames table for which `mask` (N,) holds, numbered from 0; windows and checks stay as they
        are."""
        row_of = np.cumsum(mask) - 1
        components: dict[int, Component] = {}
        for component in self.components:
            segments = [s.where(mask[s.rows]) for s in component.segments if mask[s.rows].any()]
            if segments:
                segments = [replace(s, rows=row_of[s.rows]) for s in segments]
                components[component.index] = replace(component, segments=segments)
        placed = [p for p in self.placed if p.component.index in components]
        placed = [replace(p, component=components[p.component.index]) for p in placed]
        frames = FrameVerdicts(**{name: values[mask] for name, values in vars(self.frames).items()})
        return replace(self, components=list(components.values()), placed=placed, frames=frames)


@dataclass(frozen=True, kw_only=True)
class AlignInputs:
    """What the alignment works on: import's tables `frames` and `jumps`, each session's recording, SfM's tables, rulers
    as measured in SfM's models, a data set's reference poses. `gravity_tested`: the recordings whose gravity import has
    found confirmed by the images. `given`: the first model's scale and vertical, for what it lacks of them. `numbers`:
    those that models, by their ids, have in a map that stays as it is."""

    frames: pd.DataFrame
    sfm: SfmTables
    jumps: pd.DataFrame
    recordings: dict[str, str]
    rulers: Sequence[RulerMeasurement] = ()
    reference: Reference | None = None
    gravity_tested: frozenset[str] = frozenset()
    given: GivenFrame = NOT_GIVEN
    numbers: dict[str, int] = field(default_factory=dict)


def check_models(inputs: AlignInputs, settings: AlignSettings) -> CheckedMap:
    """Check SfM's models against VIO, or a reference where no frame has VIO, and put those that pass into one map.
    Where there is neither, the largest model is the map, in SfM's unit.

    Raises UserError where there is nothing to compare; `refusal` says whether there is ground truth at all.
    """
    registered = inputs.sfm.registered
    if not registered.any():
        found, do = f"0 of {len(inputs.frames)} frames registered", "look at the sfm recording and its pairs table"
        raise UserError("nothing to align: SfM registered no frame", where="sfm.images", found=found, do=do)
    names, segments = cut_segments(inputs.frames, inputs.sfm.images, inputs.jumps, inputs.recordings, inputs.numbers)
    models = [(name, [s for s in segments if s.component == index]) for index, name in enumerate(names)]
    checks = check_registration(inputs.frames, registered, inputs.recordings, settings.min_registered_fraction)
    if inputs.reference is not None and inputs.reference.gives_map:
        return _check_by_reference(inputs, models, inputs.reference, checks, settings)
    return _check_by_vio(inputs, models, checks, settings)


def _check_by_vio(
    inputs: AlignInputs, models: Models, checks: list[CheckResult], settings: AlignSettings
) -> CheckedMap:
    frames, sfm = inputs.frames, inputs.sfm
    covariance = covariances(sfm.images["covariance"])
    components, windows = [], []
    for index, (model_id, segments) in enumerate(models):
        component = _component(index, model_id, segments, inputs, settings)
        if isinstance(component, CheckResult):
            checks.append(component)
            continue
        components.append(component)
        checks += check_standard_errors(component) + check_sessions(component, sfm, settings)
        windows += component_windows(component, largest_sd(covariance_in_map(covariance, component.metric_S_sfm)))
    checks += [result for window in windows for result in check_window(window)]
    residual_m, residual_rad = max_residuals(len(frames), windows)
    problem = np.where(np.isfinite(residual_m), "", "not compared with VIO").astype(object)
    # Links are judged by the frames that the checks before leave.
    used = exclusion_reasons(checks, sfm.not_registered) == ""
    in_use = [c for c in components if any(used[s.rows].any() for s in c.segments)]
    placed, unlinked = place_components(in_use, used, settings.vio_link_m)
    checks += check_links(placed, unlinked, settings.vio_link_m)
    verdicts = _verdicts(sfm, checks, components, problem, (residual_m, residual_rad))
    return CheckedMap(components=components, placed=placed, checks=checks, frames=verdicts, windows=windows)


def _component(
    index: int, model_id: str, segments: list[Segment], inputs: AlignInputs, settings: AlignSettings
) -> Component | CheckResult:
    """A model with its scale and vertical, or the failed check of one that has no scale and isn't the first: no VIO can
    place it then. The first may keep SfM's unit."""
    rows = registered_rows(segments)
    try:
        vio_scale = common_scale(segments)
    except GeometryError as error:
        reason = f"frames at one place in SfM are apart in VIO: {error}"
        return missing_scale(index, rows, FailureCause.VIO_INCONSISTENT, reason)
    rulers = [ruler for ruler in inputs.rulers if ruler.model_id == model_id]
    scale = scale_by_rulers(vio_scale, rulers, settings.max_ruler_size_error) or vio_scale
    max_tilt = float(np.radians(settings.max_session_tilt_deg))
    vertical = common_vertical(segments, max_tilt=max_tilt, tested=inputs.gravity_tested)
    given = inputs.given if index == 0 else NOT_GIVEN
    if given.scale is not None and not scale.is_known:
        scale = given.scale
    if given.vertical is not None and not vertical.source.is_known:
        vertical = replace(given.vertical, recordings=vertical.recordings, is_agreed=vertical.is_agreed)
    if index and not scale.is_known:
        has_vio = any(s.has_vio.any() for s in segments)
        why = "VIO hardly moves in it" if has_vio else "it has no VIO, or none but of limited tracking"
        reason = f"its SfM model has no metric scale: {why}"
        return missing_scale(index, rows, FailureCause.DISCONNECTED_SESSION, reason)
    return Component(
        index=index, model_id=model_id, segments=segments, scale=scale, vertical=vertical, vio_scale=vio_scale
    )


def _check_by_reference(
    inputs: AlignInputs, models: Models, reference: Reference, checks: list[CheckResult], settings: AlignSettings
) -> CheckedMap:
    """There are no windows: residuals are those against the reference. A ruler never sets the scale: lengths are the
    reference's."""
    limits = limits_of(reference, settings)
    residual_m, residual_rad = np.full((2, len(inputs.frames)), np.nan)
    placed = []
    for index, (model_id, segments) in enumerate(models):
        try:
            each, rows, fit = fit_component(index, model_id, segments, reference)
        except GeometryError as error:
            if index == 0:
                raise UserError(
                    "the largest SfM model can't be aligned to the reference poses",
                    where="frames that have both an SfM and a reference pose",
                    expected="3 or more, in different places",
                    found=error,
                    do="import more frames of the data set",
                ) from None
            reason = f"its SfM model can't be aligned to the reference poses: {error}"
            checks.append(missing_scale(index, registered_rows(segments), FailureCause.DISCONNECTED_SESSION, reason))
            continue
        placed.append(each)
        residual_m[rows], residual_rad[rows] = fit.position, fit.rotation
        checks += check_standard_errors(each.component)
        checks += check_session_references(each.component, rows, fit, inputs.frames, reference, limits)
        for session_id in sessions_of(segments):
            of_session, focal = registered_rows(segments, session_id), inputs.sfm.focal(model_id, session_id)
            subject = Subject(len(of_session), session_id, index)
            result = check_focal_length(subject, of_session, focal, settings.max_focal_error)
            checks += [result] if result is not None and len(of_session) else []
    is_confirmed = (residual_m <= _CONFIRMED_M) & (residual_rad <= _CONFIRMED_RAD)
    away = f"more than {_CONFIRMED_M} m or {np.degrees(_CONFIRMED_RAD):.0f} degrees from its reference pose"
    problem = np.where(np.isfinite(residual_m), np.where(is_confirmed, "", away), "no reference pose").astype(object)
    components = [each.component for each in placed]
    refused = exclusion_reasons(checks, inputs.sfm.not_registered) != ""
    for component in components:
        compared = component.registered_rows[np.isfinite(residual_m[component.registered_rows])]
        if refused[compared].mean() > _MAX_CONTRADICTING:
            problem[compared] = f"{refused[compared].sum()} of {len(compared)} frames contradict the reference"
    verdicts = _verdicts(inputs.sfm, checks, components, problem, (residual_m, residual_rad))
    limit = (limits.position(reference.extent), limits.rotation)
    return CheckedMap(components=components, placed=placed, checks=checks, frames=verdicts, reference_limit=limit)


def _verdicts(
    sfm: SfmTables,
    checks: Sequence[CheckResult],
    components: list[Component],
    problem: np.ndarray,
    residuals: tuple[np.ndarray, np.ndarray],
) -> FrameVerdicts:
    """Frames (N,) are of class C at best by an undecided check, else by `problem` (N,); in a model without scale all
    are, as limits are in metres."""
    undecided = undecided_reasons(checks, len(problem))
    problem = np.where(undecided == "", problem, undecided)
    for component in (c for c in components if not c.scale.is_known):
        for segment in component.segments:
            problem[segment.rows] = "the map has no metric scale"
    return FrameVerdicts(
        registered=sfm.registered,
        exclusion=exclusion_reasons(checks, sfm.not_registered),
        problem=problem,
        residual_m=residuals[0],
        residual_rad=residuals[1],
    )


def refusal(checked: CheckedMap, frames: pd.DataFrame, settings: AlignSettings) -> UserError | None:
    """Why there is no ground truth at all, if there isn't; counted over the frames of the dataset."""
    dataset = ~frames["support"].to_numpy(bool)
    registered, passed = checked.frames.registered[dataset], checked.frames.has_ground_truth[dataset]
    registered_fraction = registered.sum() / max(1, len(registered))
    if registered_fraction < settings.min_registered_fraction or not registered.any():
        return UserError(
            "SfM registered too few frames for ground truth",
            where="sfm.images",
            expected=f"at least {settings.min_registered_fraction:.0%} of them, and one",
            found=f"{registered.sum()} of {len(registered)} ({registered_fraction:.0%})",
            do=DEFINITIONS[CheckName.REGISTERED].remedy,
        )
    fraction, main = passed.sum() / registered.sum(), main_failure(checked.checks)
    if main is None or (fraction >= settings.min_consistent_fraction and passed.any()):
        return None
    failed = sum(check.status is Status.FAILED for check in checked.checks)
    return UserError(
        f"the SfM model fails its consistency checks: {main.cause}",
        where=_place_of(main, checked.checks, frames),
        expected=f"ground truth for at least {settings.min_consistent_fraction:.0%} of the registered frames",
        found=f"{passed.sum()} of {registered.sum()} ({fraction:.0%}); {failed} of {len(checked.checks)} checks "
        f"failed; {main.reason}",
        do=f"{main.advice}; or lower {setting_of('align', 'min_consistent_fraction')}" if passed.any() else main.advice,
    )


def _place_of(check: CheckResult, checks: Sequence[CheckResult], frames: pd.DataFrame) -> str:
    """Where a check failed: its session or model, or the frames of the worst window."""
    if check.subject.t_ns is not None:
        failed = [c for c in checks if c.status is Status.FAILED and c.name is check.name]
        worst = max(failed, key=lambda c: (c.value or 0.0) / c.limit).subject
        assert worst.t_ns is not None  # as all of that name
        of_session = frames[frames["session_id"] == worst.session_id].set_index("t_ns")["frame_id"]
        return f"worst from {of_session[worst.t_ns[0]]} to {of_session[worst.t_ns[-1]]}"
    if check.subject.session_id:
        return f"session {check.subject.session_id}"
    return f"model {check.subject.component}"
