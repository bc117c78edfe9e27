"""Rulers against the map's scale, and against each other; the scale by a ruler where the settings ask for it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.alignment.checks import RULER, About, Check, check
from groundwalk.alignment.map_frame import MapScale
from groundwalk.alignment.rulers.measurement import Reading
from groundwalk.alignment.rulers.settings import DistanceRuler
from groundwalk.artefacts.schemas import schema
from groundwalk.consistency.decisions import Status, decide

# Bounds of 95 %.
_SIGMAS = 1.96
CHECK = "ruler_scale"


@dataclass(frozen=True)
class Judged:
    """A reading, and the check of it. `scale` is the map's, by which the
    model is metric, `vio` the one by VIO alone; None where the model has none. `used`: the map's scale is by it."""

    reading: Reading
    component: int | None
    scale: MapScale | None
    vio: MapScale | None
    check: Check

    @property
    def used(self) -> bool:
        return self.scale is not None and self.reading.ruler.name in self.scale.rulers

    @property
    def part(self) -> str:
        """The part of the ruler that is judged."""
        return "held out" if self.used and "held out" in self.reading.fits else "all"


def scale_by_rulers(vio: MapScale, readings: Sequence[Reading], size_limit: float) -> MapScale | None:
    """The scale of a model by the rulers that are to set it, weighted by their standard errors; None where none may.

    A ruler takes no part that is seen too poorly, mirrored, contradicted by another one, or surely further from VIO's
    scale than `size_limit` (share): it may be printed at another size.
    """
    chosen = [r for r in readings if r.ruler.use_for_scale and _is_fit_for_scale(vio, r, readings, size_limit)]
    if not chosen:
        return None
    logs, sds = np.array([r.log_metres("used") for r in chosen]), np.array([r.sd("used") for r in chosen])
    log = float(np.average(logs, weights=sds**-2))
    excess = max(1.0, float(np.sum(((logs - log) / sds) ** 2)) / max(len(chosen) - 1, 1))
    sd = float(np.sqrt(excess / np.sum(sds**-2)))
    return MapScale(log, sd, vio.recordings, vio.weights, rulers=tuple(r.ruler.name for r in chosen))


def judge_rulers(
    component: int, scale: MapScale, vio: MapScale, readings: Sequence[Reading], size_limit: float
) -> list[Judged]:
    """Check each ruler of a model against its scale."""
    return [_judge(component, scale, vio, reading, readings, size_limit) for reading in readings]


def unjudged(readings: Sequence[Reading]) -> list[Judged]:
    """Rulers of no model, or of one without scale: undecided."""
    return [
        Judged(r, None, None, None, _undecided(r, None, r.problem or "its model has no scale or vertical"))
        for r in readings
    ]


def _undecided(reading: Reading, component: int | None, why: str) -> Check:
    about = About(reading.frames, component=component)
    reason = f"{reading.ruler.name}: {why}"
    return check(CHECK, None, None, 0.0, about, RULER, reason, status=Status.UNDECIDED)


def rulers_table(judged: Sequence[Judged]) -> pd.DataFrame:
    """The align.rulers table: a row a ruler, model and part of the ruler."""
    rows = [row for one in judged for row in _rows(one)]
    table = pd.DataFrame(rows, columns=schema("align", "rulers").column_names)
    numbers = [c.name for c in schema("align", "rulers").columns if c.dtype == "float64"]
    return table.astype({"component": "Int64"} | dict.fromkeys(numbers, float))


def describe(judged: Judged) -> str:
    """A line for the user."""
    reading, name, scale, vio = judged.reading, judged.reading.ruler.name, judged.scale, judged.vio
    if not reading.fits or scale is None or not scale.is_known:
        return f"ruler {judged.check.reason}: {judged.check.status}"
    fit = reading.fits[judged.part]
    text = (
        f"ruler {name}: {len(fit.frames)} frames, {_corner_count(judged, judged.part)} corners"
        f"{' held out' if judged.part == 'held out' else ''}, views {np.degrees(fit.angle):.0f}° apart, "
        f"{_by_vio(reading, scale, vio)}"
    )
    if scale.rulers or scale.reference:
        text += f"; map's scale {100 * np.expm1(scale.log - reading.log_metres(judged.part)):+.2f} %"
    text += f"; corners {fit.reprojection_px:.2f} px RMS"
    if not isinstance(reading.ruler, DistanceRuler):
        text += f", {1000 * fit.corner_rms_m:.2f} mm RMS, flat to {1000 * fit.flatness_m:.2f} mm"
    if judged.used:
        text += "; sets the scale"
    elif reading.ruler.use_for_scale:
        text += "; not used for scale"
    return "; ".join(filter(None, [f"{text}: {judged.check.status}", judged.check.reason, *reading.notes]))


def _by_vio(reading: Reading, scale: MapScale, vio: MapScale | None) -> str:
    ruler_percent = 100 * _SIGMAS * reading.sd()
    if vio is None or not vio.is_known:
        why = "the map's scale is the reference's" if scale.reference else "VIO moves too little to give a scale"
        return f"95 % bounds ± {ruler_percent:.2f} %; {why}"
    error_percent = 100 * np.expm1(vio.log - reading.log_metres())
    return (
        f"VIO's scale {error_percent:+.2f} % (95 % bounds: VIO's ± {100 * _SIGMAS * vio.sd:.2f} %, the ruler's "
        f"± {ruler_percent:.2f} %)"
    )


def _judge(
    component: int, scale: MapScale, vio: MapScale, reading: Reading, readings: Sequence[Reading], size_limit: float
) -> Judged:
    name = reading.ruler.name
    part = "held out" if name in scale.rulers and "held out" in reading.fits else "all"
    why = reading.problem
    if not why and name in scale.rulers and part == "all":
        why = "it sets the scale, and no corners are left to judge it by"
    if not why and not scale.is_known:
        why = (
            "the map is in the reference's unit, which isn't known"
            if scale.reference
            else "the map has no metric scale"
        )
    if why:
        return Judged(reading, component, scale, vio, _undecided(reading, component, why))
    # Corners held out share their board's stated size with those that set the scale.
    sd = float(np.hypot(scale.sd, reading.fits[part].sd if part == "held out" else reading.sd(part)))
    error = float(np.expm1(scale.log - reading.log_metres(part)))
    fault = _fault(scale, reading, readings)
    reason = f"{name}: {fault or _size_fault(scale, reading, part, error, sd)}"
    status = Status.FAILED if fault else decide(abs(error), sd, size_limit)
    about = About(len(reading.fits[part].frames), component=component)
    value = None if fault else abs(error)
    result = check(CHECK, value, sd, size_limit, about, RULER, reason, status=status)
    return Judged(reading, component, scale, vio, result)


def _is_fit_for_scale(vio: MapScale, reading: Reading, readings: Sequence[Reading], size_limit: float) -> bool:
    if reading.problem or reading.fits["all"].mirrored or _contradicting(reading, readings):
        return False
    if not vio.is_known:
        return True
    error = abs(float(np.expm1(vio.log - reading.log_metres())))
    return decide(error, float(np.hypot(vio.sd, reading.sd())), size_limit) is not Status.FAILED


def _contradicting(reading: Reading, readings: Sequence[Reading]) -> Reading | None:
    """Another ruler of the model that measures otherwise, beyond the 95 % bounds of both."""
    for other in readings:
        if other is reading or other.problem or other.fits["all"].mirrored:
            continue
        if abs(reading.log_metres() - other.log_metres()) > _SIGMAS * np.hypot(reading.sd(), other.sd()):
            return other
    return None


def _fault(scale: MapScale, reading: Reading, readings: Sequence[Reading]) -> str:
    """Why a ruler that is seen well enough says nothing of scale: mirrored, or contradicted by another ruler."""
    if reading.fits["all"].mirrored:
        return "mirrored: its corners run the other way round as seen from its front; print it unmirrored"
    other = _contradicting(reading, readings)
    if other is None:
        return ""
    apart = abs(float(np.expm1(reading.log_metres() - other.log_metres())))
    limit = _SIGMAS * float(np.hypot(reading.sd(), other.sd()))
    this, that = _measured("its", scale, reading), _measured(f"{other.ruler.name}'s", scale, other)
    return (
        f"disagrees with ruler {other.ruler.name} by {apart:.1%}, 95 % bounds {limit:.1%}: in the map {this}, "
        f"and {that}; measure both again"
    )


def _measured(whose: str, scale: MapScale, reading: Reading, part: str = "all") -> str:
    ruler, size = reading.ruler, reading.size_mm(float(np.exp(scale.log)), part)
    verb = "measures" if isinstance(ruler, DistanceRuler) else "measure"
    return f"{whose} {ruler.size_name} {verb} {size:.4g} mm, {ruler.size_mm:g} mm stated"


def _size_fault(scale: MapScale, reading: Reading, part: str, error: float, sd: float) -> str:
    by = f"ruler {', '.join(scale.rulers)}" if scale.rulers else "the reference" if scale.reference else "VIO"
    what = _measured("its", scale, reading, part)
    return f"in the map scaled by {by} {what} ({error:+.1%} ± {sd:.1%})"


def _corner_count(judged: Judged, part: str) -> int:
    return int(np.isfinite(judged.reading.fits[part].xyz).all(axis=1).sum())


def _rows(judged: Judged) -> list[dict[str, object]]:
    reading = judged.reading
    common: dict[str, object] = {
        "ruler": reading.ruler.name,
        "kind": reading.ruler.kind,
        "component": judged.component,
        "used_for_scale": judged.used,
        "stated_mm": reading.ruler.size_mm,
        "map_scale_sd_percent": None if judged.scale is None else 100 * judged.scale.sd,
        "status": judged.check.status,
        "reason": "; ".join([judged.check.reason, *reading.notes]).strip("; "),
    }
    scale, vio = judged.scale, judged.vio
    if not reading.fits or scale is None or not scale.is_known:
        return [common | {"part": "all", "frames": reading.frames, "corners": 0, "outliers": 0}]
    rows = []
    for part, fit in reading.fits.items():
        rows.append(
            common
            | {
                "part": part,
                "frames": len(fit.frames),
                "corners": _corner_count(judged, part),
                "outliers": int((~fit.inlier).sum()),
                "measured_mm": reading.size_mm(float(np.exp(scale.log)), part),
                "scale_error_percent": 100 * float(np.expm1(scale.log - reading.log_metres(part))),
                "scale_sd_percent": 100 * reading.sd(part),
                "vio_scale_error_percent": None
                if vio is None or not vio.is_known
                else 100 * float(np.expm1(vio.log - reading.log_metres(part))),
                "vio_scale_sd_percent": None if vio is None or not vio.is_known else 100 * vio.sd,
                "reprojection_px": fit.reprojection_px,
                "corner_rms_mm": 1000 * fit.corner_rms_m,
                "flatness_mm": 1000 * fit.flatness_m,
                "view_angle_deg": float(np.degrees(fit.angle)),
            }
        )
    return rows
