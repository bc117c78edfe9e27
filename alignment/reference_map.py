"""SfM's models in the frame of reference poses, where no frame has VIO."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from groundwalk.alignment.checks import BROKEN_OFF, About, Check, check
from groundwalk.alignment.components import Model, Placed, check_standard_errors
from groundwalk.alignment.reference import Reference, check_session_references, fit_component
from groundwalk.alignment.rulers.measurement import Reading
from groundwalk.alignment.rulers.verdict import Judged, judge_rulers, unjudged
from groundwalk.alignment.session_checks import Session, check_focal
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.artefacts import UserError
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array


class ReferenceMap(NamedTuple):
    """The models that the reference places, all checks of them but those of rulers, each ruler's, and by rows of the
    frames table how far a frame is from its reference pose, in the reference's unit and radians, NaN without one."""

    placed: list[Placed]
    checks: list[Check]
    rulers: list[Judged]
    worst_m: Array
    worst_rad: Array


def place_on_reference(
    models: Sequence[Model], sfm: SfmTables, settings: AlignSettings, readings: Sequence[Reading], reference: Reference
) -> ReferenceMap:
    """Each model in the reference's frame by a fit of its own, its sessions checked against it, and its rulers
    judged. A ruler never sets the scale here: lengths are the reference's.

    Raises UserError where the largest model can't be put onto the reference.
    """
    placed: list[Placed] = []
    checks: list[Check] = []
    rulers: list[Judged] = []
    worst_m, worst_rad = np.full((2, len(reference.map_T_cam)), np.nan)
    for index, model in enumerate(models):
        measured = [reading for reading in readings if reading.model_id == model.name]
        try:
            fit = fit_component(index, model, reference, settings)
        except GeometryError as error:
            checks.append(_broken_off(index, model, error))
            rulers += unjudged(measured)
            continue
        component = fit.placed.component
        placed.append(fit.placed)
        worst_m[fit.rows], worst_rad[fit.rows] = fit.fit.position, fit.fit.rotation
        rulers += judge_rulers(index, component.scale, component.vio_scale, measured, settings.ruler_size_limit)
        checks += check_standard_errors(component, settings)
        checks += check_session_references(fit, settings)
        checks += _focal_checks(index, model, sfm, settings)
    names = {model.name for model in models}
    rulers += unjudged([reading for reading in readings if reading.model_id not in names])
    return ReferenceMap(placed, checks, rulers, worst_m, worst_rad)


def _broken_off(index: int, model: Model, error: GeometryError) -> Check:
    if index == 0:
        raise UserError(
            "SfM's model can't be put onto the reference poses",
            where="frames that have both an SfM and a reference pose",
            expected="3 or more, in different places",
            found=error,
            do="import more frames of the data set",
        ) from None
    rows = np.concatenate([s.rows[s.registered] for s in model.segments])
    reason = f"its part of the model can't be put onto the reference: {error}"
    return check("component_metric", None, None, 0.0, About(len(rows), component=index), BROKEN_OFF, reason, rows=rows)


def _focal_checks(index: int, model: Model, sfm: SfmTables, settings: AlignSettings) -> list[Check]:
    checks = []
    for session_id in dict.fromkeys(s.session_id for s in model.segments):
        rows = np.concatenate([s.rows[s.registered] for s in model.segments if s.session_id == session_id])
        focal = sfm.focal(model.name, session_id)
        if focal is not None and len(rows):
            checks.append(check_focal(Session(About(len(rows), session_id, index), rows, settings), focal))
    return checks
