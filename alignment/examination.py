"""Is the model right? Scale and vertical of each of its parts, and every check before ground truth is given out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from groundwalk.alignment.agreement import Window, check_window, compare_component, worst_by_frame
from groundwalk.alignment.checks import (
    BROKEN_OFF,
    DISAGREES,
    NO_VERTICAL,
    OTHER_SCENE,
    TOO_FEW,
    About,
    Check,
    check,
    doubts,
    main_failure,
    refusal_reasons,
    setting,
    with_status,
)
from groundwalk.alignment.components import BridgeSd, Component, Model, Placed, check_standard_errors, place_components
from groundwalk.alignment.map_frame import common_scale, common_vertical
from groundwalk.alignment.quality import check_unsure, sfm_covariances
from groundwalk.alignment.reference import Reference
from groundwalk.alignment.reference_map import place_on_reference
from groundwalk.alignment.rulers.measurement import Reading
from groundwalk.alignment.rulers.verdict import Judged, judge_rulers, scale_by_rulers, unjudged
from groundwalk.alignment.segments import Segment, cut_segments, frame_components
from groundwalk.alignment.session_checks import check_sessions
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.alignment.uncertainty import covariance_in_map, largest_sd
from groundwalk.artefacts import UserError
from groundwalk.consistency.decisions import Status
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.consistency.windows import PoseSd
from groundwalk.geometry import GeometryError

NOT_REGISTERED = "SfM didn't register it"
NOT_COMPARED = "not compared with VIO"
NOT_METRIC = "the map has no metric scale"
# What a frame of class A or B is inside of with 95 %: a reference that says otherwise confirms neither.
_TOLERANCE_M, _TOLERANCE_RAD = 0.25, float(np.radians(2.0))
NOT_CONFIRMED = "more than 0.25 m or 2 degrees from its reference pose"
NO_REFERENCE = "no reference pose"


@dataclass(frozen=True)
class Examination:
    """The models that are metric and upright, where each lies in the map, and all checks. Arrays are over the rows of
    the frames table: `registered`, `reason` (why a frame gets no ground truth, empty where it does), `problem` (why one
    that does is of class C at best), the largest residuals of its windows (or those against the reference, where that
    gives the map) in metres and radians, NaN in none. `rulers` holds what became of each ruler, `refusal` is why there
    is no ground truth at all."""

    components: list[Component]
    placed: list[Placed]
    windows: list[Window]
    checks: list[Check]
    registered: np.ndarray
    reason: np.ndarray
    problem: np.ndarray
    worst_m: np.ndarray
    worst_rad: np.ndarray
    rulers: list[Judged]
    refusal: UserError | None
    reference: Reference | None = None

    @property
    def used(self) -> np.ndarray:
        """(N,) frames with ground truth."""
        return self.registered & (self.reason == "")

    def where(self, wanted: np.ndarray) -> "Examination":
        """The rows of the frames table for which `wanted` (N,) holds, numbered from 0; windows and checks stay as they
        are."""
        row_of = np.cumsum(wanted) - 1

        def part(segments: list[Segment]) -> list[Segment]:
            return [s.where(wanted[s.rows]).renumbered(row_of) for s in segments if wanted[s.rows].any()]

        components = {c.index: replace(c, segments=part(c.segments), pieces=part(c.pieces)) for c in self.components}
        placed = [replace(p, component=components[p.component.index]) for p in self.placed]
        return replace(
            self,
            components=[c for c in components.values() if c.segments],
            placed=[p for p in placed if p.component.segments],
            registered=self.registered[wanted],
            reason=self.reason[wanted],
            problem=self.problem[wanted],
            worst_m=self.worst_m[wanted],
            worst_rad=self.worst_rad[wanted],
            reference=None if self.reference is None else self.reference.where(wanted),
        )


def examine(
    frames: pd.DataFrame,
    sfm: SfmTables,
    jumps: pd.DataFrame,
    recordings: dict[str, str],
    settings: AlignSettings,
    readings: Sequence[Reading] = (),
    reference: Reference | None = None,
) -> Examination:
    """Check SfM's models against VIO, or a reference where no frame has VIO, and put those that pass into one map.

    `frames` and `jumps` are import's tables, `readings` of rulers by SfM's models. Raises UserError where there is
    nothing to compare; why there is no ground truth at all is in `refusal`.
    """
    images = sfm.images
    if not images["registered"].any():
        raise UserError(
            "there is nothing to align: SfM registered no frame",
            where="sfm.images",
            found=f"0 of {len(images)} frames registered",
            do="look at the sfm recording and its pairs table",
        )
    registered = images["registered"].to_numpy(bool)
    names, component_of = frame_components(frames, images)
    drift, sd = settings.vio_drift, PoseSd(settings.position_sd_m, float(np.radians(settings.rotation_sd_deg)))
    cut = partial(cut_segments, frames, images, jumps, recordings, component_of)
    segments = cut(jump_m=settings.segment_jump_m, jump_deg=settings.segment_jump_deg)
    # Scale and agreement are compared between all jumps, also those that an alignment lives with.
    pieces = cut(jump_m=0.0, jump_deg=0.0)
    models = [
        Model(name, [s for s in segments if s.component == index], [p for p in pieces if p.component == index])
        for index, name in enumerate(names)
    ]
    checks, components, windows = _registered_checks(frames, registered, recordings, settings), [], []
    if reference is not None and reference.gives_map:
        return _examine_by_reference(frames, models, sfm, settings, readings, reference, checks)
    covariance = sfm_covariances(images["covariance"])
    rulers: list[Judged] = []
    for index, model in enumerate(models):
        measured = [reading for reading in readings if reading.model_id == model.name]
        component, results = _component(index, model, settings, measured)
        checks += results
        if component is None:
            rulers += unjudged(measured)
            continue
        components.append(component)
        rulers += judge_rulers(index, component.scale, component.vio_scale, measured, settings.ruler_size_limit)
        checks += check_sessions(component, sfm, drift, settings)
        frame_sd = largest_sd(covariance_in_map(covariance, component.metric_S_sfm))
        windows += compare_component(component, settings, drift, sd, frame_sd)
    rulers += unjudged([reading for reading in readings if reading.model_id not in names])
    checks += [judged.check for judged in rulers]
    for window in windows:
        checks += check_window(window)
    worst_m, worst_rad = worst_by_frame(len(frames), windows)

    def reasons() -> np.ndarray:
        return refusal_reasons(checks, registered, NOT_REGISTERED)

    not_compared = np.where(np.isfinite(worst_m), "", NOT_COMPARED).astype(object)
    used = registered & (reasons() == "")
    checks += check_unsure(components, frames, images, used, not_compared, settings)
    placed, results = _place(components, registered & (reasons() == ""), settings, drift, sd)
    checks += results
    doubt = doubts(checks, len(frames))
    reason = reasons()
    return Examination(
        components,
        placed,
        windows,
        checks,
        registered,
        reason,
        _problems(np.where(doubt == "", not_compared, doubt), components),
        worst_m,
        worst_rad,
        rulers,
        _refusal(checks, windows, registered, registered & (reason == ""), frames, settings),
        reference,
    )


def _problems(problem: np.ndarray, components: list[Component]) -> np.ndarray:
    """Why frames (N,) are of class C at best; in a model without scale all are, as limits are in metres."""
    for component in (c for c in components if not c.scale.is_known):
        for segment in component.segments:
            problem[segment.rows] = NOT_METRIC
    return problem


def _examine_by_reference(
    frames: pd.DataFrame,
    models: Sequence[Model],
    sfm: SfmTables,
    settings: AlignSettings,
    readings: Sequence[Reading],
    reference: Reference,
    registered_checks: list[Check],
) -> Examination:
    """The same where the reference gives the map: there are no windows, residuals are those against it."""
    registered = sfm.images["registered"].to_numpy(bool)
    placed, results, rulers, worst_m, worst_rad = place_on_reference(models, sfm, settings, readings, reference)
    components = [p.component for p in placed]
    checks = [*registered_checks, *results, *(judged.check for judged in rulers)]
    confirmed = (worst_m <= _TOLERANCE_M) & (worst_rad <= _TOLERANCE_RAD)
    problem = np.where(np.isfinite(worst_m), np.where(confirmed, "", NOT_CONFIRMED), NO_REFERENCE).astype(object)
    doubt = doubts(checks, len(frames))
    reason = refusal_reasons(checks, registered, NOT_REGISTERED)
    return Examination(
        components,
        placed,
        [],
        checks,
        registered,
        reason,
        _problems(np.where(doubt == "", problem, doubt), components),
        worst_m,
        worst_rad,
        rulers,
        _refusal(checks, [], registered, registered & (reason == ""), frames, settings),
        reference,
    )


def _registered_checks(
    frames: pd.DataFrame, registered: np.ndarray, recordings: dict[str, str], settings: AlignSettings
) -> list[Check]:
    """Enough frames of all, and of each recording: a few that a VIO jump cut off tell nothing by themselves. Support
    frames that SfM didn't register cost the dataset nothing. The shares are counts: they have no standard error."""
    dataset = np.flatnonzero(~frames["support"])
    known, count = int(registered[dataset].sum()), len(dataset)
    reason = f"SfM registered {known} of {count} frames"
    limit = settings.least_registered
    checks = [check("registered", known / count, None, limit, About(count), TOO_FEW, reason)]
    recording = frames["session_id"].map(lambda session_id: recordings.get(session_id, session_id))
    for _, rows_in_dataset in frames.iloc[dataset].groupby(recording.iloc[dataset], sort=True).indices.items():
        rows = dataset[rows_in_dataset]
        known, count = int(registered[rows].sum()), len(rows)
        sessions = sorted(set(frames["session_id"].iloc[rows]))
        # Hardly a frame of a whole recording finds its place in the scene.
        cause = OTHER_SCENE if known < 0.1 * count and registered.any() else TOO_FEW
        reason = f"SfM registered {known} of the {count} frames of {', '.join(sessions)}"
        checks.append(check("session_registered", known / count, None, limit, About(count, sessions[0]), cause, reason))
    return checks


def _component(
    index: int, model: Model, settings: AlignSettings, rulers: Sequence[Reading]
) -> tuple[Component | None, list[Check]]:
    """A model's scale and vertical, and the checks of them; None where it has no vertical, or no scale and isn't the
    first: no VIO can place it then. The first may keep SfM's unit."""
    rows = np.concatenate([s.rows[s.registered] for s in model.segments])
    about = About(len(rows), component=index)

    def refuse(kind: str, cause: str, why: str) -> tuple[None, list[Check]]:
        return None, [check(kind, None, None, 0.0, about, cause, why, rows=rows)]

    try:
        vio_scale = common_scale(
            model.pieces, step_m=settings.step_m, step_sd=settings.step_scale_sd, phone_sd=settings.phone_scale_sd
        )
    except GeometryError as error:
        return refuse("component_metric", DISAGREES, f"SfM puts frames in one place that VIO has apart: {error}")
    scale = scale_by_rulers(vio_scale, rulers, settings.ruler_size_limit) or vio_scale
    vertical = common_vertical(model.segments, phone_sd=float(np.radians(settings.phone_tilt_sd_deg)))
    if vertical is None:
        return refuse("component_vertical", NO_VERTICAL, "no registered frame has a gravity vector")
    if index and not scale.is_known:
        return refuse("component_metric", BROKEN_OFF, "its part of the model has no scale: VIO hardly moves in it")
    component = Component(index, model.name, model.segments, model.pieces, scale, vertical, vio_scale)
    return component, check_standard_errors(component, settings)


def _place(
    components: list[Component], used: np.ndarray, settings: AlignSettings, drift: VioDrift, sd: PoseSd
) -> tuple[list[Placed], list[Check]]:
    """One map of all models that VIO ties to the first; the others' frames get no ground truth. How far VIO alone goes
    between them is a length that is known; what it drifts by there is in the frames' covariances."""
    if not used.any():
        return [], []
    placed, untied = place_components(
        [c for c in components if any(used[s.rows].any() for s in c.segments)],
        used,
        window_m=settings.window_m / 2,
        longest_m=settings.bridge_m,
        drift=drift,
        sd=sd,
        bridge_sd=BridgeSd(settings.bridge_m_per_sqrt_m, float(np.radians(settings.bridge_deg_per_sqrt_m))),
    )
    checks = []
    for each in placed[1:]:
        if each.bridge is not None:
            about = About(each.component.frames, each.bridge.session_id, each.component.index)
            checks.append(check("component_tied", each.bridge.gap_m, None, settings.bridge_m, about, BROKEN_OFF, ""))
    mapped = {s.recording for p in placed for s in p.component.segments if s.registered.any()}
    for lost in untied:
        # A VIO jump parts a recording too: what is left of it is no other scene.
        elsewhere = lost.gap_m is None and mapped.isdisjoint(s.recording for s in lost.component.segments)
        about = About(lost.component.frames, component=lost.component.index)
        rows = np.concatenate([s.rows[s.registered] for s in lost.component.segments])
        cause = OTHER_SCENE if elsewhere else BROKEN_OFF
        checks.append(check("component_tied", None, None, settings.bridge_m, about, cause, lost.reason, rows=rows))
    return placed, checks


def _refusal(
    checks: Sequence[Check],
    windows: Sequence[Window],
    registered: np.ndarray,
    used: np.ndarray,
    frames: pd.DataFrame,
    settings: AlignSettings,
) -> UserError | None:
    dataset = ~frames["support"].to_numpy(bool)
    registered, used = registered[dataset], used[dataset]
    share = registered.mean()
    if share < settings.least_registered:
        return UserError(
            "SfM registered too few frames for ground truth",
            where="sfm.images",
            expected=f"at least {settings.least_registered:.0%} of them",
            found=f"{registered.sum()} of {len(registered)} ({share:.0%})",
            do=checks[0].advice,
        )
    good = used.sum() / registered.sum()
    main = main_failure(checks)
    if main is None or (good >= settings.least_agreeing and used.any()):
        return None
    where = f"session {main.about.session_id}" if main.about.session_id else f"model {main.about.component}"
    if main.about.t_ns is not None:
        largest = max(windows, key=lambda w: float(w.position_m.max() / w.limit_m))
        ids = frames["frame_id"].to_numpy(str)[largest.segment.rows[largest.inside]]
        where = f"worst from {ids[0]} to {ids[-1]}"
    failed = len(with_status(checks, Status.FAILED))
    return UserError(
        f"the SfM model is wrong: {main.cause}" if main.cause != NO_VERTICAL else "the map has no vertical",
        where=where,
        expected=f"ground truth for at least {settings.least_agreeing:.0%} of the registered frames",
        found=f"{used.sum()} of {registered.sum()} ({good:.0%}); {failed} of {len(checks)} checks failed; "
        f"{main.reason}",
        do=f"{main.advice}; or lower {setting('least_agreeing')}" if used.any() else main.advice,
    )
