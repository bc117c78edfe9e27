"""Control points against the map: what is wrong with a survey, how far its points are off, and the check of it."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import PlacedComponent, Vertical
from groundwalk.alignment.control.points import ControlPoints
from groundwalk.alignment.ground_truth import poses_in_map
from groundwalk.alignment.rulers.measurement import observations_of
from groundwalk.alignment.sfm_tables import covariances
from groundwalk.alignment.uncertainty import covariance_in_map
from groundwalk.consistency.decisions import Status, beyond, decide
from groundwalk.geometry import GeometryError
from groundwalk.geometry.control import ControlFit, fit_control
from groundwalk.geometry.fits import Sim3, fit_sim3
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rulers import triangulate_points
from groundwalk.store.choices import CheckName, FailureCause, VerticalSource

Mask = NDArray[np.bool_]

_DETECTION_SD_PX = 0.1
# A point is wrong where it is off by more than so many standard errors, and by more than the limit.
_OUTLIER_SIGMAS = 4.0
_MIN_AGREEING = 4
# Of threes of points: one of right ones is among them where half of the points are wrong.
_TRIALS = 200
# 95 % of a chi-square of three degrees of freedom.
_CHI2_95 = 7.815
_UNITS = {"feet": 0.3048, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
# A map's own scale is off by less.
_UNIT_TOLERANCE = 0.05
# Neither a level's error nor that of a phone's gravity.
_MAX_TILT_DEG = 5.0
_NO_ESTIMATE = Quantity()
UP = {"z": np.array([0.0, 0.0, 1.0]), "y": np.array([0.0, 1.0, 0.0])}


@dataclass(frozen=True)
class MappedPoints:
    """A survey's K points in the map: coordinates (K, 3) and covariances (K, 3, 3), NaN where two frames don't see one;
    how many frames (K,) see each; and remarks, by point."""

    xyz: Array
    covariance: Array
    frames: NDArray[np.int64]
    remarks: dict[int, str]


@dataclass(frozen=True, kw_only=True)
class ControlCheck:
    """A survey against the map. `used` (K,) are the points in `fit`, which is None where there is none; `scale` is how
    much longer the map is than the survey, as a fraction (where it has no scale, the metres of its unit), `tilt_deg`
    the angle between the verticals, each with its standard error. `sets_scale`: the map's scale is by this survey, and
    each half of its points is fitted with a scale of its own."""

    points: ControlPoints
    mapped: MappedPoints
    used: Mask
    fit: ControlFit | None
    scale: tuple[float, float]
    tilt_deg: tuple[float, float]
    result: CheckResult
    sets_scale: bool = False

    @property
    def error_m(self) -> Array:
        """(K,) how far each point is off by the fit of the other half."""
        return np.full(len(self.used), np.nan) if self.fit is None else np.linalg.norm(self.fit.held_out, axis=1)

    @property
    def expected_m(self) -> Array:
        """(K,) what `error_m` is expected to be, by the standard errors of survey, images, poses, scale and fit."""
        if self.fit is None:
            return np.full(len(self.used), np.nan)
        return np.asarray(np.sqrt(np.trace(self.fit.held_out_covariance, axis1=1, axis2=2)))

    @property
    def held_out(self) -> Mask:
        """(K,) points that a fit of the others judges."""
        return np.asarray(np.isfinite(self.error_m))

    @property
    def rms_m(self) -> tuple[float, float]:
        """The root mean square of `error_m` and of `expected_m`; NaN where no point is judged."""
        rows = self.held_out
        if not rows.any():
            return float("nan"), float("nan")
        error, expected = (float(np.sqrt(np.mean(values[rows] ** 2))) for values in (self.error_m, self.expected_m))
        return error, expected

    @property
    def within_bounds(self) -> Mask:
        """(K,) held-out points that are within their 95 % bounds."""
        within = np.zeros(len(self.used), dtype=bool)
        if self.fit is not None:
            rows = self.held_out
            error, covariance = self.fit.held_out[rows], self.fit.held_out_covariance[rows]
            within[rows] = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) <= _CHI2_95
        return within


def check_control(
    points: ControlPoints, frames: pd.DataFrame, images: pd.DataFrame, placed: Sequence[PlacedComponent], usable: Mask
) -> ControlCheck:
    """Triangulate a survey's points by the map's poses of the `usable` frames (N,) and compare them with the survey: by
    a rigid fit, or by a similarity where the map has no scale or it is by this survey."""
    mapped, main = _mapped(points, frames, images, placed, usable), placed[0].component
    limit, scale_sd = points.settings.max_error_m, float(np.nan_to_num(main.scale.sd))
    sets_scale = main.scale.given_by == scale_source(points)
    rigid = main.scale.is_known and not sets_scale
    usable_points: Mask = np.asarray(np.isfinite(mapped.xyz).all(axis=1))
    # What the map knows no better than the limit judges nothing; without a scale, by that of all points.
    if rigid or usable_points.sum() >= _MIN_AGREEING:
        similar = None if rigid else _agreeing(points, points.xyz_m, mapped, usable_points)[0]
        unit = similar.scale if similar is not None else 1.0
        sd_m = unit * np.sqrt(np.trace(mapped.covariance, axis1=1, axis2=2))
        for index in np.flatnonzero(usable_points & (sd_m > limit)).tolist():
            mapped.remarks.setdefault(index, f"the map has it to ± {sd_m[index]:.2g} m, worse than the limit")
        usable_points = np.asarray(usable_points & (sd_m <= limit))
    seen = int(usable_points.sum())
    subject = Subject(len(np.unique(points.row)), component=main.index)
    unknown = (float("nan"), float("nan"))
    check = ControlCheck(
        points=points,
        mapped=mapped,
        used=np.zeros(len(points.names), dtype=bool),
        fit=None,
        scale=unknown,
        tilt_deg=unknown,
        result=_result(points, subject, Status.UNDECIDED, f"{seen} of {len(points.names)} points are seen well enough"),
        sets_scale=sets_scale,
    )
    if seen < _MIN_AGREEING:
        return check
    similar, used = _agreeing(points, points.xyz_m, mapped, usable_points)
    if fault := _fault(points, mapped, usable_points, similar, used, rigid=rigid):
        return replace(check, result=_result(points, subject, Status.FAILED, fault))
    try:
        arguments = points.xyz_m, points.sd_m, mapped.xyz, mapped.covariance, used
        fit, free = fit_control(*arguments, rigid=rigid, scale_sd=scale_sd), fit_control(*arguments, rigid=False)
    except GeometryError as error:
        return replace(check, result=_result(points, subject, Status.UNDECIDED, str(error)))
    scale, up = free.survey_S_map.scale, UP.get(points.settings.up)
    scale_sd = float(np.sqrt(free.covariance[6, 6]))
    of_scale = (1 / scale - 1, scale_sd) if rigid else (scale, scale * scale_sd)
    tilt_deg = unknown if up is None else _tilt_deg(fit, up, main.vertical)
    check = replace(check, used=used, fit=fit, scale=of_scale, tilt_deg=tilt_deg)
    if beyond(*check.tilt_deg, _MAX_TILT_DEG):
        what = "mirrored: its up is the map's down" if check.tilt_deg[0] > 90 else "its up isn't the map's"
        fault = f"{what} (tilt {check.tilt_deg[0]:.0f}°); are two of its axes exchanged, or is it not level?"
        return replace(check, fit=None, result=_result(points, subject, Status.FAILED, fault))
    wrong = _wrong(points, mapped, similar, usable_points & ~used)
    mapped.remarks.update(wrong)
    if not check.held_out.any():
        why = f"only {int(used.sum())} points agree, too few to hold half of them out"
        status = Status.FAILED if wrong else Status.UNDECIDED
        return replace(check, result=_result(points, subject, status, _listed(points, wrong) or why))
    rms, expected = check.rms_m
    sd = expected / np.sqrt(2 * check.held_out.sum())
    status = Status.FAILED if wrong else decide(rms, sd, limit)
    reason = f"held-out points are {1000 * rms:.1f} mm off (RMS), limit {1000 * limit:g} mm; {describe_figures(check)}"
    return replace(check, result=_result(points, subject, status, _listed(points, wrong) or reason, Quantity(rms, sd)))


def scale_source(points: ControlPoints) -> str:
    """A map's `scale_source` where this survey gives it."""
    return f"control: {points.settings.name}"


def describe(check: ControlCheck) -> str:
    """A line for the user."""
    name, total = check.points.settings.name, len(check.points.names)
    text = f"control {name}: {int(check.used.sum())} of {total} points agree"
    return "; ".join(filter(None, [text, describe_figures(check), f"{check.result.status}", check.result.reason]))


def describe_figures(check: ControlCheck) -> str:
    """Errors, scale and tilt in words; empty without a fit."""
    if check.fit is None:
        return ""
    parts = []
    if check.held_out.any():
        worst, (rms, expected) = int(np.nanargmax(check.error_m)), check.rms_m
        parts.append(
            f"held out {1000 * rms:.1f} mm RMS (expected {1000 * expected:.1f}), "
            f"worst {1000 * check.error_m[worst]:.1f} mm at {check.points.names[worst]}, "
            f"{np.mean(check.within_bounds[check.held_out]):.0%} within 95 % bounds"
        )
    is_metric = check.fit.survey_S_map.scale == 1.0
    value, sd = check.scale
    if check.sets_scale:
        parts.append(f"sets the map's scale ± {sd:.2%}")
    else:
        parts.append(f"scale {value:+.2%} ± {sd:.2%}" if is_metric else f"{value:.6g} ± {sd:.2g} m per unit of the map")
    if np.isfinite(check.tilt_deg[0]):
        parts.append("tilt {:.2f}° ± {:.2f}°".format(*check.tilt_deg))
    return ", ".join(parts)


def _mapped(
    points: ControlPoints, frames: pd.DataFrame, images: pd.DataFrame, placed: Sequence[PlacedComponent], usable: Mask
) -> MappedPoints:
    covariance, unit = np.full((len(frames), 6, 6), np.nan), np.ones(len(frames))
    in_sfm = covariances(images["covariance"])
    for each in placed:
        rows = each.component.registered_rows
        covariance[rows], unit[rows] = covariance_in_map(in_sfm[rows], each.map_S_sfm), each.map_S_sfm.scale
    map_T_cam = poses_in_map(images, placed)
    observations = observations_of(frames, images, points.row, points.point, points.xy_px)
    assert observations.cam_T_row is not None
    observations.cam_T_row[:, :3, 3] *= unit[points.row, None]
    seen = usable[points.row] & np.isfinite(map_T_cam[points.row, 0, 0]) & np.isfinite(observations.xy).all(axis=1)
    used, count = observations.where(seen), len(points.names)
    is_read_off = points.settings.images or points.settings.in_one_file
    min_sd = points.settings.pixel_sd if is_read_off else _DETECTION_SD_PX
    xyz, of_point, inlier = triangulate_points(used, map_T_cam, covariance, count, min_pixel_sd=min_sd)
    seen_by, kept = (np.bincount(corner, minlength=count) for corner in (used.corner, used.corner[inlier]))
    remarks = dict(points.remarks)
    for index in range(count):
        if seen_by[index] < 2:
            remarks.setdefault(index, f"seen by {seen_by[index]} frames of the map, 2 are needed")
        elif kept[index] <= seen_by[index] / 2:
            found = f"{seen_by[index] - kept[index]} of {seen_by[index]} observations don't fit the poses"
            remarks.setdefault(index, f"{found}: is it there twice, or was it moved?")
    return MappedPoints(xyz, of_point, seen_by, remarks)


def _agreeing(points: ControlPoints, survey: Array, mapped: MappedPoints, usable: Mask) -> tuple[Sim3 | None, Mask]:
    """The similarity survey_S_map that most points agree with within the limit, and these points (K,). The scale is
    free, so that a map whose scale is off doesn't make right points wrong."""
    rng, rows, tolerance = np.random.default_rng(0), np.flatnonzero(usable), _tolerance(points, mapped)
    best, agree = None, np.zeros(len(survey), dtype=bool)
    for _ in range(_TRIALS):
        sample = rng.choice(rows, 3, replace=False)
        for _ in range(2):  # the three, then all that agree with them
            with suppress(GeometryError):
                fit = fit_sim3(survey[sample], mapped.xyz[sample])
                close = usable & (_distances(survey, fit, mapped) <= tolerance)
                if close.sum() > agree.sum():
                    best, agree = fit, close
                    sample = np.flatnonzero(close)
    return best, agree


def _distances(survey: Array, fit: Sim3, mapped: MappedPoints) -> Array:
    return np.asarray(np.linalg.norm(survey - fit.points(mapped.xyz), axis=1))


def _tolerance(points: ControlPoints, mapped: MappedPoints) -> Array:
    variance = points.sd_m**2 + np.trace(mapped.covariance, axis1=1, axis2=2) / 3
    return np.maximum(points.settings.max_error_m, _OUTLIER_SIGMAS * np.sqrt(variance))


def _fault(
    points: ControlPoints, mapped: MappedPoints, usable: Mask, similar: Sim3 | None, used: Mask, *, rigid: bool
) -> str:
    """What is wrong with a survey as a whole; empty where nothing is."""
    count, enough = int(usable.sum()), max(_MIN_AGREEING, usable.sum() / 2)
    _, mirrored = _agreeing(points, points.xyz_m * [-1, 1, 1], mapped, usable)
    if mirrored.sum() > used.sum() and mirrored.sum() >= enough:
        return (
            f"mirrored: {int(used.sum())} of {count} points agree with the map, {int(mirrored.sum())} with x negated; "
            "are two of its axes exchanged? It is to be right-handed, as east, north, up"
        )
    for unit, metres in _UNITS.items() if rigid and used.sum() < enough else ():
        # Limits in metres are wide or narrow in another unit.
        in_metres, agree = _agreeing(points, metres * points.xyz_m, mapped, usable)
        if in_metres and agree.sum() >= enough and abs(in_metres.scale - 1) <= _UNIT_TOLERANCE:
            times = in_metres.scale / metres
            return f"its coordinates are {times:.4g} times the map's: they are in {unit}, metres are expected"
    if similar is None or used.sum() < enough:
        return (
            f"only {int(used.sum())} of {count} points agree with the map within {points.settings.max_error_m:g} m, at "
            "any scale: are the names those of the survey, and is it as good as max_error_m says?"
        )
    for unit, metres in _UNITS.items() if rigid else ():
        if abs(similar.scale * metres - 1) <= _UNIT_TOLERANCE:
            return f"its coordinates are {similar.scale:.4g} times the map's: they are in {unit}, metres are expected"
    return ""


def _wrong(points: ControlPoints, mapped: MappedPoints, similar: Sim3 | None, outlier: Mask) -> dict[int, str]:
    """Points that don't agree with the others, by index, and how."""
    assert similar is not None
    rows, tolerance = np.flatnonzero(outlier), _tolerance(points, mapped)
    off = _distances(points.xyz_m, similar, mapped)
    wrong = {int(row): f"{off[row]:.3g} m from where the images have it, limit {tolerance[row]:.2g} m" for row in rows}
    for a, b in combinations(rows.tolist(), 2):
        exchanged = points.xyz_m.copy()
        exchanged[[a, b]] = exchanged[[b, a]]
        if (_distances(exchanged, similar, mapped) <= tolerance)[[a, b]].all():
            wrong[a] = wrong[b] = f"{points.names[a]} and {points.names[b]} are exchanged: {off[a]:.3g} m off as listed"
    return wrong


def _listed(points: ControlPoints, wrong: dict[int, str]) -> str:
    """The wrong points in words, each reason once."""
    told = (text if "exchanged" in text else f"{points.names[row]} is {text}" for row, text in wrong.items())
    return "; ".join(dict.fromkeys(told))


def _tilt_deg(fit: ControlFit, up: Array, vertical: Vertical) -> tuple[float, float]:
    """The angle between the survey's vertical and the map's +y, and its standard error; NaN where the map has none or
    a survey gave it."""
    in_survey = fit.survey_S_map.rotation[:, 1]
    across = fit.covariance[:3, :3] - np.outer(in_survey, in_survey @ fit.covariance[:3, :3])
    angle = np.arctan2(np.linalg.norm(np.cross(up, in_survey)), up @ in_survey)
    sd = np.sqrt(np.linalg.eigvalsh(across + across.T)[-1] / 2 + vertical.sd**2)
    is_compared = vertical.source.is_known and vertical.source is not VerticalSource.CONTROL
    return (float(np.degrees(angle)) if is_compared else float("nan")), float(np.degrees(sd))


def _result(
    points: ControlPoints, subject: Subject, status: Status, reason: str, estimate: Quantity = _NO_ESTIMATE
) -> CheckResult:
    failure = Failure(cause=FailureCause.CONTROL_INCONSISTENT, reason=f"{points.settings.name}: {reason}")
    return evaluate(CheckName.CONTROL_POINTS, subject, estimate, points.settings.max_error_m, failure, status)
