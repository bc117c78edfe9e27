"""Where on earth the map is, for who asked for it: by positions that phones state, or by a survey in WGS84."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.components import MapScale, PlacedComponent
from groundwalk.alignment.control.check import ControlCheck
from groundwalk.consistency.decisions import Status
from groundwalk.geometry import GeometryError
from groundwalk.geometry.earth import MIN_FIXES, EarthFit, Origin, enu_of, fit_earth
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import Clock, ScaleSource, VerticalSource
from groundwalk.store.georeference import Georeference

# Phones state 65 m and more where they know Wi-Fi or cells alone.
_MAX_ACCURACY_M = 30.0
_UNSTATED_ACCURACY_M = 10.0
# A circle with 68 % of positions has this radius in standard errors of an axis.
_RADIUS_OF_AXIS = 1.51
_VERTICAL_OF_RADIUS = 1.5  # height's standard error, where it isn't stated
_MIN_SD_M = 1.0
_MAX_GAP_NS = 3_000_000_000  # between the frames around a position
_MAX_YAW_DEG = _MAX_TILT_DEG = 10.0
# Fixes of another place: further off, in standard errors and metres.
_OUTLIER_SIGMAS = 5.0
_MAX_SCALE_ERROR, _SCALE_SIGMAS = 0.1, 4.0
# Altitudes of two recordings that are further apart, in standard errors, aren't above the same level.
_ALTITUDE_SIGMAS = 2.5
_SURVEY = "or name surveyed points in WGS84 (docs/how-to/control-points.md)"


class NoGeoreference(Exception):
    """Why the map can't be placed on earth, with figures and what to do."""


def of_surveys(checks: Sequence[ControlCheck], placed: Sequence[PlacedComponent]) -> Georeference | None:
    """By the first survey in WGS84 that passes its check and has a vertical; None where there is none."""
    for check in checks:
        points, fit = check.points, check.fit
        if points.origin is None or fit is None or check.result.status is not Status.PASSED:
            continue
        off = np.linalg.norm(points.xyz_m - fit.survey_S_map.points(check.mapped.xyz), axis=1)[check.used]
        return Georeference(
            source=points.settings.name,
            origin=points.origin,
            enu_S_map=fit.survey_S_map,
            covariance=_with_scale(fit.covariance, placed[0].component.scale),
            middle=check.mapped.xyz[check.used].mean(axis=0),
            stated=len(points.names),
            used=len(off),
            rms_m=float(np.sqrt(np.mean(off**2))),
            worst_m=float(off.max()),
            gives_scale=not placed[0].component.scale.is_known,
        )
    return None


def of_gps(
    gps: pd.DataFrame,
    frames: pd.DataFrame,
    recordings: Mapping[str, str],
    map_T_cam: Array,
    placed: Sequence[PlacedComponent],
) -> Georeference:
    """By import's table `gps`; `map_T_cam` (N, 4, 4) are poses of the rows of `frames`, NaN of those without ground
    truth. Raises NoGeoreference where positions are too few, too rough, of another place, or along too short a walk."""
    main, remarks, stated = placed[0].component, list[str](), len(gps)
    # What these positions gave says nothing of them.
    rigid = main.scale.is_known and main.scale.given_by != ScaleSource.GPS
    is_upright = main.vertical.source.is_known and main.vertical.source is not VerticalSource.GPS
    if not stated:
        raise NoGeoreference(
            "no recording states a position on earth: photos, 3D Scanner App and ios_logger do where they had leave to "
            f"use the place; capture so, {_SURVEY}"
        )
    accuracy = gps["accuracy_m"].fillna(_UNSTATED_ACCURACY_M)
    is_rough = accuracy > _MAX_ACCURACY_M
    if is_rough.any():
        remarks.append(f"{is_rough.sum()} of an accuracy of {accuracy[is_rough].min():.0f} m or worse")
    gps, accuracy = gps[~is_rough], accuracy[~is_rough]
    xyz = _at_fixes(gps, frames, recordings, map_T_cam)
    has_place: NDArray[np.bool_] = np.asarray(np.isfinite(xyz).all(axis=1))
    if not has_place.all():
        remarks.append(f"{int((~has_place).sum())} while no frame with ground truth was taken")
    gps, accuracy, xyz = gps[has_place], accuracy[has_place], xyz[has_place]
    if len(gps) < MIN_FIXES:
        raise NoGeoreference(
            f"{len(gps)} of {stated} positions can be used, {MIN_FIXES} are needed ({'; '.join(remarks)}): record "
            f"under the open sky, and begin once the phone states {_MAX_ACCURACY_M:.0f} m or better, {_SURVEY}"
        )
    geodetic = gps[["latitude_deg", "longitude_deg", "altitude_m"]].to_numpy(float, copy=True)
    if len(np.unique(geodetic[:, :2], axis=0)) < MIN_FIXES:
        raise NoGeoreference(
            f"the phone repeated an old position {len(gps)} times: record again once it moves, {_SURVEY}"
        )
    horizontal = np.maximum(accuracy.to_numpy(float) / _RADIUS_OF_AXIS, _MIN_SD_M)
    vertical = gps["altitude_sd_m"].fillna(_VERTICAL_OF_RADIUS * accuracy).to_numpy(float)
    sd = np.column_stack([horizontal, horizontal, np.maximum(vertical, _MIN_SD_M)])
    recording, of_recording = pd.factorize(gps["recording"])
    names = [str(name) for name in of_recording]
    walk, seconds = recording.astype(np.int64), gps["t_ns"].to_numpy(float) * 1e-9
    vertical_sd = float(main.vertical.sd) if is_upright else None
    while True:
        origin = _middle(geodetic)
        enu = enu_of(origin, geodetic)
        if vertical_sd is None and np.isfinite(enu[:, 2]).sum() < MIN_FIXES:
            raise NoGeoreference(
                f"the map's vertical isn't known, and positions without altitude don't tell it{_left_out(remarks)}: "
                f"record with a phone's VIO, which knows gravity, {_SURVEY}"
            )
        try:
            fit = fit_earth(enu, sd, xyz, seconds, walk, rigid=rigid, vertical_sd=vertical_sd)
        except GeometryError as error:
            raise NoGeoreference(f"{error}: walk further, {_SURVEY}") from None
        apart = _heights_apart(fit.residual[:, 2], sd[:, 2], walk, names)
        if not apart:
            break
        remarks.append(apart)
        geodetic[:, 2] = np.nan
    off_m = np.linalg.norm(fit.residual[:, :2], axis=1)
    is_off = off_m > _OUTLIER_SIGMAS * horizontal
    _refuse_another_place(is_off, fit.residual, walk, names)
    _refuse_unsure(fit, xyz, sd, rigid=rigid)
    if is_off.any():
        remarks.append(f"{int(is_off.sum())} that are up to {_distance(off_m.max())} from where the others have them")
    used = off_m[~is_off]
    return Georeference(
        source="gps",
        origin=origin,
        enu_S_map=fit.enu_S_map,
        covariance=_with_scale(fit.covariance, main.scale),
        middle=fit.middle,
        stated=stated,
        used=len(used),
        rms_m=float(np.sqrt(np.mean(used**2))),
        worst_m=float(used.max()),
        gives_scale=not main.scale.is_known,
        remarks=remarks,
    )


def _with_scale(covariance: Array, scale: MapScale) -> Array:
    """A fit's covariance (7, 7) with the variance of the map's own scale, where a rigid fit took that as it is."""
    result = covariance.copy()
    result[6, 6] = covariance[6, 6] or scale.sd**2
    return result


def _left_out(remarks: Sequence[str]) -> str:
    return f" (left out: {', '.join(remarks)})" if remarks else ""


def _heights_apart(residual: Array, sd: Array, walk: np.ndarray, names: Sequence[str]) -> str:
    """Which recordings' altitudes (N,) differ by more than errors explain, as where one states them above the ellipsoid
    and another above sea level; empty where none do."""
    known = np.isfinite(residual)
    table = pd.DataFrame({"off": residual, "sd": sd})[known].groupby(walk[known]).median()
    if len(table) < 2:
        return ""
    at, off, sd_of = table.index.to_numpy(int), table["off"].to_numpy(float), table["sd"].to_numpy(float)
    high, low = int(off.argmax()), int(off.argmin())
    apart_m = off[high] - off[low]
    if apart_m <= _ALTITUDE_SIGMAS * np.hypot(sd_of[high], sd_of[low]):
        return ""
    return (
        f"all altitudes, as {names[at[low]]} has them {apart_m:.0f} m lower than {names[at[high]]}, "
        "by the map: is one above sea level, the other above the ellipsoid?"
    )


def _middle(geodetic: Array) -> Origin:
    """Medians, which few positions of another place don't move; of longitudes from one of them on, as they begin anew
    at 180 degrees. Without any altitude that is 0."""
    altitudes = geodetic[np.isfinite(geodetic[:, 2]), 2]
    one = geodetic[0, 1]
    longitude = (one + np.median((geodetic[:, 1] - one + 180) % 360 - 180) + 180) % 360 - 180
    altitude = float(np.median(altitudes)) if len(altitudes) else 0.0
    return float(np.median(geodetic[:, 0])), float(longitude), altitude


def _at_fixes(gps: pd.DataFrame, frames: pd.DataFrame, recordings: Mapping[str, str], map_T_cam: Array) -> Array:
    """Where the camera was in the map (K, 3) at the time of each position; NaN where no two frames around it say."""
    xyz, known = np.full((len(gps), 3), np.nan), np.isfinite(map_T_cam[:, 0, 0])
    recording, t_ns = frames["session_id"].map(recordings).to_numpy(str), frames["t_ns"].to_numpy()
    for name, of_one in gps.groupby("recording", sort=True):
        rows = np.flatnonzero((recording == str(name)) & known)
        if not len(rows):
            continue
        rows = rows[np.argsort(t_ns[rows], kind="stable")]
        times, at = t_ns[rows], of_one["t_ns"].to_numpy()
        after = np.clip(np.searchsorted(times, at), 0, len(rows) - 1)
        before = np.where(times[after] == at, after, np.maximum(after - 1, 0))
        timeless = frames["clock"].iloc[rows[0]] == Clock.NAME_ORDER
        near = (times[before] <= at) & (at <= times[after])
        near &= times[after] - times[before] <= (0 if timeless else _MAX_GAP_NS)
        path = map_T_cam[rows, :3, 3]
        share = (at - times[before]) / np.maximum(times[after] - times[before], 1)
        between = path[before] + share[:, None] * (path[after] - path[before])
        xyz[gps.index.get_indexer(of_one.index)] = np.where(near[:, None], between, np.nan)
    return xyz


def _refuse_another_place(is_off: np.ndarray, residual: Array, walk: np.ndarray, names: Sequence[str]) -> None:
    """NoGeoreference where positions of half of the recordings, or half of all, don't fit the others."""
    bad = [i for i in range(len(names)) if is_off[walk == i].mean() > 0.5]
    if 2 * len(bad) < len(names) and is_off.mean() <= 0.5:
        return
    middle = np.stack([np.median(residual[walk == i, :2], axis=0) for i in range(len(names))])
    apart = np.linalg.norm(middle[:, None] - middle, axis=2)
    a, b = divmod(int(np.argmax(apart)), len(names))
    if len(names) > 1:
        what = f"those of {names[a]} and {names[b]} by {_distance(apart[a, b])}"
    else:
        what = f"half of those of {names[0]}, by {_distance(float(np.median(np.linalg.norm(residual[:, :2], axis=1))))}"
    raise NoGeoreference(
        f"positions contradict the map: {what}; nothing tells which are right: take the recording of "
        f"another place out, {_SURVEY}"
    )


def _distance(metres: float) -> str:
    return f"{metres:.3g} m" if metres < 1000 else f"{metres / 1000:.3g} km"


def _refuse_unsure(fit: EarthFit, xyz: Array, sd: Array, *, rigid: bool) -> None:
    """NoGeoreference where the positions span too little for a heading, or another length than the map."""
    sds = np.degrees(np.sqrt(np.diag(fit.covariance)))
    yaw, tilt = float(sds[2]), float(max(sds[:2]))
    span_m = fit.enu_S_map.scale * float(np.linalg.norm(np.ptp(xyz, axis=0)))
    if yaw > _MAX_YAW_DEG or tilt > _MAX_TILT_DEG:
        what, angle, limit = ("heading", yaw, _MAX_YAW_DEG) if yaw >= tilt else ("vertical", tilt, _MAX_TILT_DEG)
        raise NoGeoreference(
            f"the walk is too short for a {what}: over {span_m:.3g} m with positions of ± {np.median(sd[:, 0]):.2g} m "
            f"an axis it is known to ± {angle:.2g}°, limit {limit:g}°: walk about {span_m * angle / limit:.2g} m, "
            f"{_SURVEY}"
        )
    error = abs(fit.free_scale - 1)
    if rigid and error > max(_MAX_SCALE_ERROR, _SCALE_SIGMAS * np.radians(yaw)):
        raise NoGeoreference(
            f"positions move {fit.free_scale:.2g} m for each metre of the map: they are of another walk, or the phone "
            f"repeated an old one; record again under the open sky, {_SURVEY}"
        )
