"""Is the model right? Scale and vertical of each of its parts, and every check before ground truth is given out."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from alignment.agreement import Window, compare, worst_by_frame
from alignment.components import BridgeSd, Component, Placed, place_components
from alignment.gate import (
    BROKEN_OFF,
    DISAGREES,
    INTRINSICS,
    LOOK_ALIKE,
    MIRRORED,
    OTHER_SCENE,
    TOO_FEW,
    VIO_SCALE,
    VIO_VERTICAL,
    Gate,
)
from alignment.map_frame import MapScale, common_scale, common_vertical
from alignment.quality import contradicted, judge, sfm_covariances
from alignment.reference import Reference, check_sessions, fit_component
from alignment.rulers.measurement import Reading
from alignment.rulers.verdict import Judged, judge_rulers, scale_by_rulers, unjudged
from alignment.segments import Segment, cut_segments, frame_components
from alignment.settings import AlignSettings
from alignment.sfm_tables import Focal, SfmTables
from alignment.uncertainty import covariance_in_map
from artefacts import UserError
from geometry import GeometryError
from geometry.diagnosis import Diagnosis, diagnose
from geometry.fits import direction_angles
from geometry.motion_agreement import MISTAKES
from geometry.poses import Array
from geometry.vio_agreement import PoseSd
from geometry.vio_drift import VioDrift

NOT_REGISTERED = "SfM didn't register it"

# Faults that leave no part of a model right: which of two places is it, and how far does one focal length bend all?
_OF_THE_WHOLE = {
    "session_folded": "look-alike places are folded together in its model",
    "session_turns": "its model is bent by a session whose intrinsics are wrong",
    "session_focal": "its model is bent by a session whose intrinsics are wrong",
}
# Images count as telling a focal length beyond the bound and so many sigmas. Where a walk hardly tells it from depth,
# as straight on, what isn't modelled decides, and the sigma is large.
_FOCAL_SIGMAS = 5.0
# What a frame of class A or B is inside of with 95 %: a reference that says otherwise confirms neither.
_TOLERANCE_M, _TOLERANCE_RAD = 0.25, float(np.radians(2.0))
_OTHERWISE = (DISAGREES, "SfM moves otherwise than VIO in most steps")


@dataclass
class Examination:
    """What was found. Arrays are over the rows of the frames table: `registered`, `reason` (why a frame gets no ground
    truth, empty where it does), the largest residuals of its windows in metres and radians (or those against the
    reference, where that gives the map), NaN in none. `refusal` is why there is no ground truth at all, `rulers` what
    became of each ruler."""

    components: list[Component]
    placed: list[Placed]
    windows: list[Window]
    gate: Gate
    registered: np.ndarray
    reason: np.ndarray
    worst_m: Array
    worst_rad: Array
    refusal: UserError | None = None
    diagnoses: dict[tuple[int, str], Diagnosis] = field(default_factory=dict)
    reference: Reference | None = None
    rulers: list[Judged] = field(default_factory=list)

    @property
    def used(self) -> np.ndarray:
        """(N,) frames with ground truth."""
        return self.registered & (self.reason == "")

    def where(self, wanted: np.ndarray) -> "Examination":
        """What was found of the rows of the frames table for which `wanted` (N,) holds, numbered from 0; windows and
        checks stay as they are."""
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
            worst_m=self.worst_m[wanted],
            worst_rad=self.worst_rad[wanted],
            reference=None if self.reference is None else self.reference.where(wanted),
        )

    @property
    def checked(self) -> np.ndarray:
        """(N,) frames that were compared with VIO, or with a reference in metres that confirms them."""
        known = np.isfinite(self.worst_m)
        if self.reference is not None and self.reference.gives_map:
            known &= (self.worst_m <= _TOLERANCE_M) & (self.worst_rad <= _TOLERANCE_RAD)
        return known & self.is_metric

    @property
    def is_metric(self) -> bool:
        """The map's unit is the metre: not where a reference of unknown unit gives it."""
        return self.reference is None or self.reference.metric or not self.reference.gives_map


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
    nothing to compare; a model that is wrong is told in `refusal`.
    """
    images = sfm.images
    if not images["registered"].any():
        raise UserError(
            "there is nothing to align: SfM registered no frame",
            where="sfm.images",
            found=f"0 of {len(images)} frames registered",
            do="look at the sfm recording and its pairs table",
        )
    names, component_of = frame_components(frames, images)
    gate, count = Gate(), len(frames)
    found = Examination(
        [],
        [],
        [],
        gate,
        images["registered"].to_numpy(bool),
        np.where(images["registered"], "", NOT_REGISTERED).astype(object),
        np.full(count, np.nan),
        np.full(count, np.nan),
    )
    found.reference = reference
    _check_registered(found, frames, recordings, settings)
    drift = _drift(settings)
    sd = PoseSd(settings.position_sd_m, float(np.radians(settings.rotation_sd_deg)))
    cut = partial(cut_segments, frames, images, jumps, recordings, component_of)
    segments = cut(jump_m=settings.segment_jump_m, jump_deg=settings.segment_jump_deg)
    # Scale and agreement are compared between all jumps, also those that an alignment lives with.
    pieces = cut(jump_m=0.0, jump_deg=0.0)
    if reference is not None and reference.gives_map:
        _place_on_reference(found, names, segments, pieces, sfm, settings, readings)
        found.refusal = _refusal(found, frames, settings)
        return found
    for index, name in enumerate(names):
        own = [s for s in segments if s.component == index]
        rulers = [reading for reading in readings if reading.model_id == name]
        component = _component(found, index, name, own, [p for p in pieces if p.component == index], settings, rulers)
        if component is None:
            continue
        found.components.append(component)
        _check_sessions(found, component, sfm, drift, settings)
        for piece in component.pieces:
            windows = compare(piece, component.metric_S_sfm, settings.window_m, drift, sd)
            metres, radians, wrong = worst_by_frame(piece, windows)
            found.worst_m[piece.rows], found.worst_rad[piece.rows] = metres, radians
            _refuse(found, piece.rows[wrong], "SfM and VIO disagree here")
            found.windows += windows
    found.rulers += unjudged(gate, [reading for reading in readings if reading.model_id not in names])
    for window in found.windows:
        gate.check_window(window)
    _check_unsure(found, frames, images, settings)
    _place(found, settings, drift, sd)
    found.refusal = _refusal(found, frames, settings)
    return found


def _place_on_reference(
    found: Examination,
    names: list[str],
    segments: list[Segment],
    pieces: list[Segment],
    sfm: SfmTables,
    settings: AlignSettings,
    readings: Sequence[Reading],
) -> None:
    """Each model in the reference's frame by a fit of its own, its sessions checked against it, and its rulers
    judged. A ruler never sets the scale here: lengths are the reference's."""
    assert found.reference is not None
    for index, name in enumerate(names):
        own, parts = ([s for s in of if s.component == index] for of in (segments, pieces))
        rulers = [reading for reading in readings if reading.model_id == name]
        try:
            fit = fit_component(index, name, own, parts, found.reference, settings)
        except GeometryError as error:
            rows = np.concatenate([s.rows[s.registered] for s in own])
            if index == 0:
                raise UserError(
                    "SfM's model can't be put onto the reference poses",
                    where="frames that have both an SfM and a reference pose",
                    expected="3 or more, in different places",
                    found=error,
                    do="import more frames of the data set",
                ) from None
            reason = f"its part of the model can't be put onto the reference: {error}"
            about: dict[str, Any] = {"component": index, "frames": len(rows), "at_least": True}
            found.gate.check("component_metric", None, 0.0, "m", BROKEN_OFF, reason, **about)
            _refuse(found, rows, reason)
            found.rulers += unjudged(found.gate, rulers)
            continue
        if found.is_metric:
            found.rulers += judge_rulers(
                found.gate, index, fit.placed.component.scale, None, rulers, settings.ruler_size_limit
            )
        else:
            found.rulers += unjudged(found.gate, rulers, "the map is in the reference's unit, which isn't known")
        found.components.append(fit.placed.component)
        found.placed.append(fit.placed)
        found.worst_m[fit.rows], found.worst_rad[fit.rows] = fit.fit.position, fit.fit.rotation
        for rows, reason in check_sessions(found.gate, fit, settings):
            _refuse(found, rows, reason)
        for session_id in dict.fromkeys(s.session_id for s in own):
            rows = np.concatenate([s.rows[s.registered] for s in own if s.session_id == session_id])
            about = {"session_id": session_id, "component": index, "frames": len(rows)}
            for reason in _focal_faults(found.gate, sfm.focal(name, session_id), settings, about):
                _refuse(found, rows, reason)
    found.rulers += unjudged(found.gate, [reading for reading in readings if reading.model_id not in names])


def _drift(settings: AlignSettings) -> VioDrift:
    return VioDrift.in_degrees(
        settings.vio_drift_m,
        settings.vio_drift_m_per_m,
        settings.vio_drift_deg,
        settings.vio_drift_deg_per_root_m,
    )


def _refuse(found: Examination, rows: np.ndarray, reason: str) -> None:
    """Give no ground truth to these rows; the first reason stays."""
    rows = rows[found.reason[rows] == ""]
    found.reason[rows] = reason


def _check_registered(
    found: Examination, frames: pd.DataFrame, recordings: dict[str, str], settings: AlignSettings
) -> None:
    """Enough frames of all, and of each recording: a few that a VIO jump cut off tell nothing by themselves. Support
    frames that SfM didn't register cost the dataset nothing."""
    dataset = np.flatnonzero(~frames["support"])
    known, count = int(found.registered[dataset].sum()), len(dataset)
    found.gate.check(
        "registered",
        known / count,
        settings.least_registered,
        "share",
        TOO_FEW,
        f"SfM registered {known} of {count} frames",
        frames=count,
        at_least=True,
    )
    recording = frames["session_id"].map(lambda session_id: recordings.get(session_id, session_id))
    for _, rows_in_dataset in frames.iloc[dataset].groupby(recording.iloc[dataset], sort=True).indices.items():
        rows = dataset[rows_in_dataset]
        known, count = int(found.registered[rows].sum()), len(rows)
        sessions = sorted(set(frames["session_id"].iloc[rows]))
        found.gate.check(
            "session_registered",
            known / count,
            settings.least_registered,
            "share",
            # Hardly a frame of a whole recording finds its place in the scene.
            OTHER_SCENE if known < 0.1 * count and found.registered.any() else TOO_FEW,
            f"SfM registered {known} of the {count} frames of {', '.join(sessions)}",
            session_id=sessions[0],
            frames=count,
            at_least=True,
        )


def _component(
    found: Examination,
    index: int,
    name: str,
    segments: list[Segment],
    pieces: list[Segment],
    settings: AlignSettings,
    rulers: Sequence[Reading],
) -> Component | None:
    """A model's scale and vertical, and its rulers judged; None, and noted, where they can't be had. The first model's
    must."""
    try:
        scale, vio_scale = _scales(pieces, settings, rulers)
        vertical = common_vertical(segments, phone_sd=float(np.radians(settings.phone_tilt_sd_deg)))
    except UserError as error:
        if index == 0:
            raise
        rows = np.concatenate([s.rows[s.registered] for s in segments])
        reason = f"its part of the model has no scale or vertical: {error.what}"
        found.gate.check(
            "component_metric", None, 0.0, "m", BROKEN_OFF, reason, component=index, frames=len(rows), at_least=True
        )
        _refuse(found, rows, reason)
        found.rulers += unjudged(found.gate, rulers)
        return None
    found.rulers += judge_rulers(found.gate, index, scale, vio_scale, rulers, settings.ruler_size_limit)
    return Component(index, name, segments, pieces, scale, vertical, vio_scale)


def _scales(
    pieces: list[Segment], settings: AlignSettings, rulers: Sequence[Reading]
) -> tuple[MapScale, MapScale | None]:
    """A model's scale, by rulers where they are to set it, and the one by VIO alone, None where VIO moves too little.
    Raises UserError where neither can be had."""
    try:
        vio_scale = common_scale(
            pieces,
            step_m=settings.step_m,
            least_step_m=settings.least_step_m,
            step_sd=settings.step_scale_sd,
            phone_sd=settings.phone_scale_sd,
        )
    except UserError:
        scale = scale_by_rulers(None, rulers, settings.ruler_size_limit)
        if scale is None:
            raise
        return scale, None
    return scale_by_rulers(vio_scale, rulers, settings.ruler_size_limit) or vio_scale, vio_scale


def _check_sessions(
    found: Examination, component: Component, sfm: SfmTables, drift: VioDrift, settings: AlignSettings
) -> None:
    """Each session's motion, turns, scale and vertical in one model; a session that fails gets no ground truth."""
    for session_id in dict.fromkeys(s.session_id for s in component.segments):
        own = [s for s in component.segments if s.session_id == session_id]
        rows = np.concatenate([s.rows[s.registered] for s in own])
        if not len(rows):
            continue
        about: dict[str, Any] = {"session_id": session_id, "component": component.index, "frames": len(rows)}
        diagnosis = diagnose([p.stretch for p in component.pieces if p.session_id == session_id], drift)
        found.diagnoses[component.index, session_id] = diagnosis
        focal = sfm.focal(component.model_id, session_id)
        reasons = _focal_faults(found.gate, focal, settings, about)
        belongs = sfm.belongs(session_id)
        reasons += _motion_faults(found.gate, diagnosis, settings, about, focal=focal, belongs=belongs)
        if not reasons:
            # A scale or vertical by poses that are wrong themselves would tell nothing.
            reasons = _shared_faults(found.gate, component, own[0].recording, settings, about)
        if reasons:
            _refuse(found, rows, reasons[0])


def _focal_faults(gate: Gate, focal: Focal | None, settings: AlignSettings, about: dict[str, Any]) -> list[str]:
    """The reason of the failed check of what the images say of a session's logged focal length."""
    if focal is None:
        return []
    off = focal.scale - 1
    reason = f"the images say that the focal length is {abs(off):.1%} {'more' if off > 0 else 'less'} than captured"
    limit = settings.focal_limit + _FOCAL_SIGMAS * focal.sd
    passed = gate.check("session_focal", abs(off), limit, "share", INTRINSICS, reason, **about)
    return [] if passed else [reason]


def _motion_faults(
    gate: Gate,
    diagnosis: Diagnosis,
    settings: AlignSettings,
    about: dict[str, Any],
    *,
    focal: Focal | None,
    belongs: bool,
) -> list[str]:
    """Reasons of the failed checks of a session's motion. `belongs`: pairs of its images, without any model, move as
    its VIO does, so that they do belong to its poses and the model is what is wrong."""
    reasons: list[str] = []

    def check(name: str, value: float, limit: float, cause: str, reason: str, *, at_least: bool = False) -> None:
        if not gate.check(name, value, limit, "share", cause, reason, at_least=at_least, **about):
            reasons.append(reason)

    motions = diagnosis.motions
    if motions.pairs:
        cause, reason = MISTAKES.get("" if belongs else motions.mistake or "", _OTHERWISE)
        # A mirror image that explains clearly more is a fault, however much a walk straight on agrees all the same.
        mirrored = cause == MIRRORED
        limit = max(motions.mirrors.values()) if mirrored else settings.motion_agreeing
        check("session_motion", motions.explained, limit, cause, reason, at_least=True)
    if reasons and not belongs:
        # Turns and places say nothing where motions don't agree at all.
        return reasons
    # Where the images themselves confirm the focal length, it's VIO that turns otherwise.
    if np.isfinite(motions.turn_gain) and not reasons and (focal is None or not focal.confirmed):
        word = "less" if motions.turn_gain < 1 else "more"
        check(
            "session_turns",
            abs(motions.turn_gain - 1),
            settings.turn_gain_limit + 2 * motions.turn_gain_sd,
            INTRINSICS,
            f"SfM turns {abs(motions.turn_gain - 1):.1%} {word} than VIO: the focal length isn't the captured one",
        )
    check(
        "session_folded",
        diagnosis.folded,
        settings.folded_limit,
        LOOK_ALIKE,
        f"SfM puts places together that VIO has up to {diagnosis.folded_m:.1f} m apart",
    )
    return reasons


def _shared_faults(
    gate: Gate, component: Component, recording: str, settings: AlignSettings, about: dict[str, Any]
) -> list[str]:
    """Reasons of the failed checks of a session's scale and vertical against the others'."""
    reasons: list[str] = []
    scale, vertical = component.vio_scale, component.vertical
    # One recording has no other to differ from.
    if scale is not None and recording in scale.recordings and len(scale.recordings) > 1:
        off = float(np.expm1(scale.recordings[recording].log - scale.log))
        reason = f"this session's VIO measures {abs(off):.1%} {'more' if off > 0 else 'less'} than the others'"
        # What the session's own windows can't tell apart isn't held against it.
        limit = settings.session_scale_limit + 2 * scale.recordings[recording].sd
        if not gate.check("session_scale", abs(off), limit, "share", VIO_SCALE, reason, **about):
            reasons.append(reason)
    if recording in vertical.recordings and len(vertical.recordings) > 1:
        tilt_deg = float(np.degrees(direction_angles(vertical.recordings[recording][None], vertical.up_sfm)[0]))
        reason = f"this session's gravity points {tilt_deg:.1f} degrees away from the others'"
        limit = settings.session_tilt_limit_deg
        if not gate.check("session_vertical", tilt_deg, limit, "deg", VIO_VERTICAL, reason, **about):
            reasons.append(reason)
    return reasons


def _check_unsure(found: Examination, frames: pd.DataFrame, images: pd.DataFrame, settings: AlignSettings) -> None:
    """A frame of class A or B stands on its own: its 95 % bounds of 0.3 degrees are 7 cm at the end of 5 m, and VIO
    strays as far. One of class C needs VIO's word, as does one whose images doubt its focal length, which bounds take
    as known (`judge` makes it a C): it must move as VIO does, more closely than drift is allowed for elsewhere; where
    most of a session's don't, none of them is believed. That they have no ground truth is a fault of the session where
    it costs it too many frames."""
    covariance = sfm_covariances(images["covariance"])
    for component in found.components:
        own = covariance_in_map(covariance, component.metric_S_sfm)
        sure = judge(frames, images, own, found.checked, settings) != "C"
        for session_id in dict.fromkeys(s.session_id for s in component.segments):
            unsure, wrong = [], []
            for segment in (s for s in component.segments if s.session_id == session_id):
                part = segment.where(segment.both & found.used[segment.rows])
                if len(part.rows) < 2:
                    continue
                out = contradicted(
                    part, component.metric_S_sfm, sure[part.rows], settings.unsure_step_m, settings.unsure_share
                )
                wrong.extend(part.rows[out])
                unsure.extend(part.rows[~sure[part.rows]])
            if not unsure:
                continue
            lost = wrong if len(wrong) <= len(unsure) / 2 else unsure
            registered = sum(int(s.registered.sum()) for s in component.segments if s.session_id == session_id)
            found.gate.check(
                "session_unsure",
                len(lost) / registered,
                1 - settings.least_agreeing,
                "share",
                DISAGREES,
                f"of {len(unsure)} frames that SfM isn't sure of {len(wrong)} move otherwise than VIO",
                session_id=session_id,
                component=component.index,
                frames=registered,
            )
            reason = f"SfM isn't sure here, and VIO moves otherwise by more than {settings.unsure_share:.1%}"
            _refuse(found, np.array(lost, dtype=int), reason)


def _place(found: Examination, settings: AlignSettings, drift: VioDrift, sd: PoseSd) -> None:
    """One map of all models that VIO ties to the first; the others' frames get no ground truth."""
    for component in found.components:
        failed = {str(row["check"]) for row in found.gate.failed if row["component"] == component.index}
        for name in sorted(failed & _OF_THE_WHOLE.keys()):
            for segment in component.segments:
                _refuse(found, segment.rows[segment.registered], _OF_THE_WHOLE[name])
    if not found.used.any():
        return
    bridge_sd = BridgeSd(settings.bridge_m_per_sqrt_m, float(np.radians(settings.bridge_deg_per_sqrt_m)))
    found.placed, untied = place_components(
        found.components,
        found.used,
        window_m=settings.window_m / 2,
        longest_m=settings.bridge_m,
        drift=drift,
        sd=sd,
        bridge_sd=bridge_sd,
    )
    for placed in found.placed[1:]:
        if placed.bridge is not None:
            found.gate.check(
                "component_tied",
                placed.bridge.gap_m,
                settings.bridge_m,
                "m",
                BROKEN_OFF,
                "",
                session_id=placed.bridge.session_id,
                component=placed.component.index,
                frames=placed.component.frames,
            )
    mapped = {s.recording for p in found.placed for s in p.component.segments if s.registered.any()}
    for lost in untied:
        # A VIO jump parts a recording too: what is left of it is no other scene.
        elsewhere = lost.gap_m is None and mapped.isdisjoint(s.recording for s in lost.component.segments)
        found.gate.check(
            "component_tied",
            None,
            settings.bridge_m,
            "m",
            OTHER_SCENE if elsewhere else BROKEN_OFF,
            lost.reason,
            component=lost.component.index,
            frames=lost.component.frames,
        )
        for segment in lost.component.segments:
            _refuse(found, segment.rows[segment.registered], lost.reason)


def _refusal(found: Examination, frames: pd.DataFrame, settings: AlignSettings) -> UserError | None:
    dataset = ~frames["support"].to_numpy(bool)
    registered, used = found.registered[dataset], found.used[dataset]
    share = registered.mean()
    if share < settings.least_registered:
        return UserError(
            "SfM registered too few frames for ground truth",
            where="sfm.images",
            expected=f"at least {settings.least_registered:.0%} of them",
            found=f"{registered.sum()} of {len(registered)} ({share:.0%})",
            do="look at the sfm recording; more overlap between frames or sessions may be needed",
        )
    good = used.sum() / registered.sum()
    main = found.gate.main_cause
    if good >= settings.least_agreeing or main is None:
        return None
    where = f"session {main['session_id']}" if main["session_id"] else f"model {main['component']}"
    if main["t_start_ns"] is not None:
        largest = max(found.windows, key=lambda w: float(w.position_m.max() / w.limit_m))
        ids = frames["frame_id"].to_numpy(str)[largest.segment.rows[largest.inside]]
        where = f"worst from {ids[0]} to {ids[-1]}"
    failed = len(found.gate.failed)
    on_reference = found.reference is not None and found.reference.gives_map
    against = (
        "the limits around the reference poses (align.reference_limit_*)" if on_reference else "what VIO can drift"
    )
    return UserError(
        f"the SfM model is wrong: {main['cause']}",
        where=where,
        expected=f"at least {settings.least_agreeing:.0%} of the frames within {against}",
        found=f"{used.sum()} of {registered.sum()} ({good:.0%}); {failed} of {len(found.gate.rows)} checks failed; "
        f"{main['reason']}",
        do="look at the sfm recording and at the capture",
    )
