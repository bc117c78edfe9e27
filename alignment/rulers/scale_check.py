"""Rulers against the map's scale, and against each other; the scale by a ruler where the settings ask for it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import Component, MapScale
from groundwalk.alignment.rulers.measurement import RulerMeasurement
from groundwalk.alignment.settings import DistanceRuler
from groundwalk.consistency.decisions import SIGMAS, Status, decide, within
from groundwalk.geometry.rulers import RulerFit
from groundwalk.store.choices import CheckName, FailureCause, RulerPart, ScaleSource
from groundwalk.store.hints import setting_of
from groundwalk.store.schemas import schema

# Bounds of 95 %.
_BOUND_SIGMAS = 1.96


@dataclass(frozen=True)
class RulerCheck:
    """A ruler's measurement in a model (`component`, None without scale or vertical) and the check of it."""

    measurement: RulerMeasurement
    component: Component | None
    result: CheckResult

    @property
    def scale(self) -> MapScale | None:
        """The scale that makes the model metric, where it is."""
        return self.component.scale if self.component is not None and self.component.scale.is_known else None

    @property
    def vio_scale(self) -> MapScale | None:
        """The model's scale by VIO alone, where that gives one."""
        return self.component.vio_scale if self.component is not None and self.component.vio_scale.is_known else None

    @property
    def sets_scale(self) -> bool:
        """The model's scale is by this ruler."""
        return self.component is not None and self.measurement.ruler.name in self.component.scale.rulers

    @property
    def part(self) -> RulerPart:
        """The part of the ruler that is checked."""
        is_split = self.sets_scale and RulerPart.HELD_OUT in self.measurement.fits
        return RulerPart.HELD_OUT if is_split else RulerPart.ALL


def scale_by_rulers(vio: MapScale, rulers: Sequence[RulerMeasurement], max_size_error: float) -> MapScale | None:
    """The scale of a model by the rulers that are to set it, weighted by their standard errors; None where none may.

    A ruler takes no part that is seen too poorly, mirrored, contradicted by another one, or beyond the 95 % bounds of
    its difference from VIO's scale, unless that is certainly within `max_size_error` (fraction): it may be printed at
    another size.
    """
    fit = []
    for ruler in (r for r in rulers if r.ruler.use_for_scale and not r.problem):
        error, sd = _against_vio(vio, ruler) if vio.is_known else (0.0, 0.0)
        may_be_true = abs(error) <= _BOUND_SIGMAS * sd or bool(within(abs(error), sd, max_size_error))
        if may_be_true and not ruler.fits[RulerPart.ALL].mirrored and not _contradicting(ruler, rulers):
            fit.append(ruler)
    if not fit:
        return None
    part = RulerPart.FOR_SCALE
    logs, sds = np.array([r.log_metres(part) for r in fit]), np.array([r.sd(part) for r in fit])
    log = float(np.average(logs, weights=sds**-2))
    excess = max(1.0, float(np.sum(((logs - log) / sds) ** 2)) / max(len(fit) - 1, 1))
    sd = float(np.sqrt(excess / np.sum(sds**-2)))
    return MapScale(log, sd, vio.recordings, rulers=tuple(r.ruler.name for r in fit))


def check_rulers(
    components: list[Component], rulers: Sequence[RulerMeasurement], max_size_error: float
) -> list[RulerCheck]:
    """Check each ruler against the scale of its model, model by model; undecided in one without scale or vertical, or
    in none."""
    of_model = {component.model_id: component for component in components}
    checks = []
    for ruler in sorted(rulers, key=lambda r: of_model[r.model_id].index if r.model_id in of_model else len(of_model)):
        beside, component = [r for r in rulers if r.model_id == ruler.model_id], of_model.get(ruler.model_id)
        checks.append(RulerCheck(ruler, component, _check(component, ruler, beside, max_size_error)))
    return checks


def rulers_table(checks: Sequence[RulerCheck]) -> pd.DataFrame:
    """The align.rulers table: a row a ruler, model and part of the ruler."""
    rows = [row for check in checks for row in _rows(check)]
    table = pd.DataFrame(rows, columns=schema("align", "rulers").column_names)
    numbers = [c.name for c in schema("align", "rulers").columns if c.dtype == "float64"]
    return table.astype({"component": "Int64"} | dict.fromkeys(numbers, float))


def describe(check: RulerCheck) -> str:
    """A line for the user."""
    measurement, scale, result = check.measurement, check.scale, check.result
    if not measurement.fits or scale is None:
        return f"ruler {result.reason}: {result.status}"
    fit, vio, sd_percent = measurement.fits[check.part], check.vio_scale, 100 * _BOUND_SIGMAS * measurement.sd()
    if vio is not None:
        by_vio = (
            f"VIO's scale {100 * np.expm1(vio.log - measurement.log_metres()):+.2f} % (95 % bounds: VIO's "
            f"± {100 * _BOUND_SIGMAS * vio.sd:.2f} %, the ruler's ± {sd_percent:.2f} %)"
        )
    else:
        by = "the reference's" if scale.reference else f"by {scale.given_by}" if scale.given_by else ""
        why = f"the map's scale is {by}" if by else "VIO moves too little to give a scale"
        by_vio = f"95 % bounds ± {sd_percent:.2f} %; {why}"
    text = (
        f"ruler {measurement.ruler.name}: {len(fit.frames)} frames, {_corners(fit)} corners"
        f"{' held out' * (check.part is RulerPart.HELD_OUT)}, views {np.degrees(fit.angle):.0f}° apart, {by_vio}"
    )
    if scale.by != ScaleSource.VIO:
        text += f"; map's scale {100 * np.expm1(scale.log - measurement.log_metres(check.part)):+.2f} %"
    text += f"; corners {fit.reprojection_px:.2f} px RMS"
    if not isinstance(measurement.ruler, DistanceRuler):
        text += f", {1000 * fit.corner_rms_m:.2f} mm RMS, flat to {1000 * fit.flatness_m:.2f} mm"
    if check.sets_scale:
        text += "; sets the scale"
    elif measurement.ruler.use_for_scale:
        text += "; not used for scale"
    return "; ".join(filter(None, [f"{text}: {result.status}", result.reason, *measurement.notes]))


def _check(
    component: Component | None, measurement: RulerMeasurement, rulers: Sequence[RulerMeasurement], limit: float
) -> CheckResult:
    if component is None:
        return _undecided(measurement, None, measurement.problem or "its SfM model has no scale or vertical")
    scale, name = component.scale, measurement.ruler.name
    is_held_out = name in scale.rulers and RulerPart.HELD_OUT in measurement.fits
    part = RulerPart.HELD_OUT if is_held_out else RulerPart.ALL
    problem = measurement.problem
    if not problem and name in scale.rulers and not is_held_out:
        problem = "it sets the scale, and no corners are left to check it by"
    if not problem and not scale.is_known:
        problem = "the map is in the reference's unknown unit" if scale.reference else "the map has no metric scale"
    remark = _remark_on_size(component, measurement, limit)
    if problem:
        return _undecided(measurement, component.index, "; ".join(filter(None, [problem, remark])))
    # Corners held out share their board's stated size with those that set the scale.
    sd = float(np.hypot(scale.sd, measurement.fits[part].sd if is_held_out else measurement.sd(part)))
    error = float(np.expm1(scale.log - measurement.log_metres(part)))
    fault = _fault(scale, measurement, rulers)
    other = "the reference" if scale.reference else scale.given_by or "VIO"
    by = f"ruler {', '.join(scale.rulers)}" if scale.rulers else other
    size = f"in the map scaled by {by} {_measured('its', scale, measurement, part)} ({error:+.1%} ± {sd:.1%})"
    reason = fault or "; ".join(filter(None, [size, remark]))
    subject = Subject(len(measurement.fits[part].frames), component=component.index)
    estimate = Quantity(None if fault else abs(error), sd)
    failure = Failure(cause=FailureCause.RULER_INCONSISTENT, reason=f"{name}: {reason}")
    status = Status.FAILED if fault else decide(abs(error), sd, limit)
    result = evaluate(CheckName.RULER_SCALE, subject, estimate, limit, failure, status)
    # Held-out corners of a print of another size agree with those that set the scale.
    return replace(result, reason=f"{name}: {remark}") if remark and result.status is Status.PASSED else result


def _undecided(measurement: RulerMeasurement, component: int | None, problem: str) -> CheckResult:
    subject, reason = Subject(measurement.frames, component=component), f"{measurement.ruler.name}: {problem}"
    failure = Failure(cause=FailureCause.RULER_INCONSISTENT, reason=reason)
    return evaluate(CheckName.RULER_SCALE, subject, Quantity(), 0.0, failure, Status.UNDECIDED)


def _against_vio(vio: MapScale, measurement: RulerMeasurement) -> tuple[float, float]:
    """How much larger the scale by VIO is than the ruler's, as a fraction, and the standard error of both."""
    return float(np.expm1(vio.log - measurement.log_metres())), float(np.hypot(vio.sd, measurement.sd()))


def _remark_on_size(component: Component, measurement: RulerMeasurement, limit: float) -> str:
    """Of a ruler that is to set the scale: how wrong its stated size may be without VIO telling, or why it doesn't set
    the scale; empty where VIO's scale is certainly within the limit of it."""
    vio, scale = component.vio_scale, component.scale
    if not measurement.ruler.use_for_scale or measurement.problem or scale.reference:
        return ""
    sets_scale = measurement.ruler.name in scale.rulers
    if not vio.is_known:
        return "VIO gives no scale: nothing tells a stated size that is wrong" if sets_scale else ""
    error, sd = _against_vio(vio, measurement)
    if within(abs(error), sd, limit):
        return ""
    if sets_scale:
        return (
            f"VIO's scale, 95 % bounds ± {_BOUND_SIGMAS * vio.sd:.1%}, can't tell a stated size that is wrong by up to "
            f"{abs(error) + _BOUND_SIGMAS * sd:.1%}"
        )
    enough = np.ceil(100 * (abs(error) + SIGMAS * sd)) / 100
    return (
        f"{abs(error):.1%} from VIO's scale, beyond the 95 % bounds of ± {_BOUND_SIGMAS * sd:.1%}: it doesn't set the "
        f"scale; if it measures what is stated, {setting_of('align', f'max_ruler_size_error = {enough:.2f}')} lets it"
    )


def _contradicting(measurement: RulerMeasurement, rulers: Sequence[RulerMeasurement]) -> RulerMeasurement | None:
    """Another ruler of the model whose scale differs beyond the 95 % bounds of both."""
    for other in rulers:
        if other is measurement or other.problem or other.fits[RulerPart.ALL].mirrored:
            continue
        if abs(measurement.log_metres() - other.log_metres()) > _BOUND_SIGMAS * np.hypot(measurement.sd(), other.sd()):
            return other
    return None


def _fault(scale: MapScale, measurement: RulerMeasurement, rulers: Sequence[RulerMeasurement]) -> str:
    """Why a ruler that is seen well enough gives no scale: mirrored, or contradicted by another ruler."""
    if measurement.fits[RulerPart.ALL].mirrored:
        return "mirrored: its corners run the other way round as seen from its front; print it unmirrored"
    other = _contradicting(measurement, rulers)
    if other is None:
        return ""
    apart = abs(float(np.expm1(measurement.log_metres() - other.log_metres())))
    limit = _BOUND_SIGMAS * float(np.hypot(measurement.sd(), other.sd()))
    this, that = _measured("its", scale, measurement), _measured(f"{other.ruler.name}'s", scale, other)
    return (
        f"inconsistent with ruler {other.ruler.name} by {apart:.1%}, 95 % bounds {limit:.1%}: in the map {this}, "
        f"and {that}; measure both again"
    )


def _measured(whose: str, scale: MapScale, measurement: RulerMeasurement, part: RulerPart = RulerPart.ALL) -> str:
    ruler, size = measurement.ruler, measurement.size_mm(float(np.exp(scale.log)), part)
    verb = "measures" if isinstance(ruler, DistanceRuler) else "measure"
    return f"{whose} {ruler.size_name} {verb} {size:.4g} mm, {ruler.size_mm:g} mm stated"


def _corners(fit: RulerFit) -> int:
    return int(np.isfinite(fit.xyz).all(axis=1).sum())


def _rows(check: RulerCheck) -> list[dict[str, object]]:
    measurement, component, vio = check.measurement, check.component, check.vio_scale
    common: dict[str, object] = {
        "ruler": measurement.ruler.name,
        "kind": measurement.ruler.kind,
        "component": None if component is None else component.index,
        "used_for_scale": check.sets_scale,
        "stated_mm": measurement.ruler.size_mm,
        "map_scale_sd_percent": None if component is None else 100 * component.scale.sd,
        "status": check.result.status,
        "reason": "; ".join([check.result.reason, *measurement.notes]).strip("; "),
    }
    if not measurement.fits or check.scale is None:
        return [common | {"part": RulerPart.ALL, "frames": measurement.frames, "corners": 0, "outliers": 0}]
    metres_per_unit, log = float(np.exp(check.scale.log)), check.scale.log
    return [
        common
        | {
            "part": part,
            "frames": len(fit.frames),
            "corners": _corners(fit),
            "outliers": int((~fit.inlier).sum()),
            "measured_mm": measurement.size_mm(metres_per_unit, part),
            "scale_error_percent": 100 * float(np.expm1(log - measurement.log_metres(part))),
            "scale_sd_percent": 100 * measurement.sd(part),
            "vio_scale_error_percent": None
            if vio is None
            else 100 * float(np.expm1(vio.log - measurement.log_metres(part))),
            "vio_scale_sd_percent": None if vio is None else 100 * vio.sd,
            "reprojection_px": fit.reprojection_px,
            "corner_rms_mm": 1000 * fit.corner_rms_m,
            "flatness_mm": 1000 * fit.flatness_m,
            "view_angle_deg": float(np.degrees(fit.angle)),
        }
        for part, fit in measurement.fits.items()
    ]
