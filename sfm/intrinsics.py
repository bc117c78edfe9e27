"""Intrinsics refined within bounds, and only where that helps: one factor for the focal lengths of each session.

Mapping holds the captured focal lengths fixed. A finished model then says by how much each session's are off
(`estimate_focal_scales`). Where that is beyond its own uncertainty the factors are applied and the model is adjusted
anew, until it says nothing more. They are kept only where they stay within a bound and the matches that took no part in
any adjustment agree better with the poses; otherwise the model stays as it was, to the bit.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from artefacts.child import Report
from geometry.poses import Array
from sfm.database import camera_of, image_id
from sfm.focal_scale import estimate_focal_scales
from sfm.mapping import BuiltModel, adjust_robustly
from sfm.mapping_input import Ints, Matches, held_out_check
from sfm.model import Model, load_models
from sfm.settings import SfmSettings

REFINED = "refined"
AS_CAPTURED = "captured: nothing speaks against them"
UNTOLD = "captured: the images don't tell"
BEYOND = "captured: the factor is beyond the bound"
BESIDE = "captured: another session's factor is beyond the bound"
NO_BETTER = "captured: matches held out agree no better"

_ROUNDS = 4
_SETTLED = 0.0003
_FEWEST_MATCHES = 30
_TOLD = "intrinsics.json"


@dataclass(frozen=True)
class FocalScale:
    """What a model says of one session's focal lengths: the factor to them and its sigma, None where it can't tell; the
    median error of the matches held out with them as captured and with the factors, None where that wasn't tried; and
    what was decided."""

    model_id: str
    session_id: str
    frames: int
    factor: float | None
    sd: float | None
    decision: str
    heldout_px: float | None = None
    heldout_refined_px: float | None = None

    @property
    def applied(self) -> float:
        """What the captured focal lengths were multiplied by."""
        return self.factor if self.decision == REFINED and self.factor else 1.0


def first_estimates(
    model: Model, kept: Sequence[BuiltModel], frames: pd.DataFrame, limit: float
) -> list[list[FocalScale]]:
    """What each model says of its sessions, the focal lengths as captured; what is worth trying is undecided: ""."""
    session_N = frames["session_id"].to_numpy(str)
    found = []
    for number, told in enumerate(kept):
        part = model.part(number)
        scales = estimate_focal_scales(part, session_N, _intrinsics(frames), told.loss_px)
        names, counts = np.unique(session_N[part.registered], return_counts=True)
        if scales is None:
            own = zip(names.tolist(), counts.tolist(), strict=True)
            found.append([FocalScale(told.model_id, name, count, None, None, UNTOLD) for name, count in own])
            continue
        beyond = scales.differs & (np.abs(scales.factor - 1) >= limit)
        decisions = np.where(scales.differs, "", np.where(scales.known, AS_CAPTURED, UNTOLD))
        if beyond.any():
            # One session's wrong focal lengths bend what the others' points tell of theirs.
            decisions = np.where(beyond, BEYOND, BESIDE)
        frames_of = dict(zip(names.tolist(), counts.tolist(), strict=True))
        rows = zip(
            scales.sessions.tolist(), scales.factor.tolist(), scales.sd.tolist(), decisions.tolist(), strict=True
        )
        found.append([FocalScale(told.model_id, name, frames_of[name], f, sd, why) for name, f, sd, why in rows])
    return found


def with_focal_scales(frames: pd.DataFrame, scale_N: Array) -> pd.DataFrame:
    """The frames table with its focal lengths multiplied by (N,) factors."""
    return frames.assign(fx=frames["fx"] * scale_N, fy=frames["fy"] * scale_N)


def refine_models(
    report: Report,
    folder: Path,
    kept: list[BuiltModel],
    first: list[list[FocalScale]],
    frames: pd.DataFrame,
    matches: Matches,
    settings: SfmSettings,
    output: Path,
) -> None:
    """Try the factors that `first`, one list a model, leaves undecided; `output` then holds what `read_refined` reads.

    `folder` has the kept models over the N rows of `frames`; `output` has them all, too, refined or as they were.
    """
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    models, scales = [], []
    for number, (told, estimates) in enumerate(zip(kept, first, strict=True)):
        if any(not scale.decision for scale in estimates):
            told, estimates = _refine(folder / told.folder, told, estimates, frames, matches, settings, work)
        if not any(scale.decision == REFINED for scale in estimates):
            shutil.copytree(folder / told.folder, work / told.folder, dirs_exist_ok=True)
        models.append(asdict(told))
        scales.append([asdict(scale) for scale in estimates])
        report(number + 1)
    (work / _TOLD).write_text(json.dumps({"models": models, "scales": scales}), encoding="utf-8")
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def read_refined(output: Path) -> tuple[list[BuiltModel], list[list[FocalScale]]]:
    """The kept models as they are now, and what was decided of each one's sessions."""
    told = json.loads((output / _TOLD).read_text(encoding="utf-8"))
    return [BuiltModel(**m) for m in told["models"]], [[FocalScale(**s) for s in own] for own in told["scales"]]


def _refine(
    source: Path,
    told: BuiltModel,
    estimates: list[FocalScale],
    frames: pd.DataFrame,
    matches: Matches,
    settings: SfmSettings,
    work: Path,
) -> tuple[BuiltModel, list[FocalScale]]:
    """The model with its factors in `work`, where they help; the model as it was where they don't."""
    model = pycolmap.Reconstruction(source)
    session_N = frames["session_id"].to_numpy(str)
    factors = {scale.session_id: scale.factor or 1.0 for scale in estimates if not scale.decision}
    sd = {scale.session_id: scale.sd for scale in estimates}
    before = load_models([source], len(frames))
    target = work / told.folder
    target.mkdir(exist_ok=True)
    for rounds_left in reversed(range(_ROUNDS)):
        if _beyond(factors, settings.focal_limit):
            break
        scaled = with_focal_scales(frames, np.array([factors.get(s, 1.0) for s in session_N]))
        for row, frame in enumerate(scaled.itertuples(index=False)):
            if model.exists_image(image_id(row)):
                model.camera(image_id(row)).params = camera_of(frame, image_id(row)).params.tolist()
        loss_px = adjust_robustly(model, target, len(frames))
        model.write_binary(target)
        after = load_models([target], len(frames))
        scales = estimate_focal_scales(after, session_N, _intrinsics(scaled), loss_px)
        if scales is None:
            break
        sd |= dict(zip(scales.sessions.tolist(), scales.sd.tolist(), strict=True))
        moved = {
            name: factor
            for name, factor, differs in zip(scales.sessions, scales.factor.tolist(), scales.differs, strict=True)
            if differs or (name in factors and abs(factor - 1) > _SETTLED)
        }
        if not moved or not rounds_left:
            break
        factors |= {name: factors.get(name, 1.0) * factor for name, factor in moved.items()}
    rows = [
        replace(scale, factor=factors.get(scale.session_id, scale.factor), sd=sd[scale.session_id])
        for scale in estimates
    ]
    if beyond := _beyond(factors, settings.focal_limit):
        shutil.rmtree(target)
        return told, [replace(row, decision=BEYOND if row.session_id in beyond else BESIDE) for row in rows]
    judges = _held_out_of(matches, session_N, before.model, set(factors))
    captured_px = _median(held_out_check(judges, frames, before.sfm_T_cam, before.model).error_px)
    refined_px = _median(held_out_check(judges, scaled, after.sfm_T_cam, after.model).error_px)
    helps = (
        captured_px is not None
        and refined_px is not None
        and len(judges.frames) >= _FEWEST_MATCHES
        and refined_px < (1 - settings.focal_gain) * captured_px
    )
    rows = [
        replace(
            row,
            decision=(REFINED if helps else NO_BETTER) if row.session_id in factors else row.decision,
            heldout_px=captured_px,
            heldout_refined_px=refined_px,
        )
        for row in rows
    ]
    if not helps:
        shutil.rmtree(target)
        return told, rows
    return replace(told, loss_px=loss_px, mean_reprojection_px=model.compute_mean_reprojection_error()), rows


def _beyond(factors: dict[str, float], limit: float) -> set[str]:
    return {session for session, factor in factors.items() if abs(factor - 1) >= limit}


def _intrinsics(frames: pd.DataFrame) -> Array:
    return frames[["fx", "fy", "cx", "cy"]].to_numpy(float)


def _held_out_of(matches: Matches, session_N: NDArray[np.str_], model_N: Ints, sessions: set[str]) -> Matches:
    """The matches held out that a model's frames have part in, one of those sessions among them."""
    of_them = np.isin(session_N, list(sessions))
    own = matches.held_out & (model_N[matches.frames] >= 0).all(axis=1) & of_them[matches.frames].any(axis=1)
    return Matches(matches.frames[own], matches.xy_a[own], matches.xy_b[own], matches.held_out[own])


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None
