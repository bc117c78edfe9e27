"""The map frame: metric and +y up from all VIO sessions together, without leaning on VIO positions over distance.

Scale compares SfM and VIO over windows of a few metres, so that VIO's drift over a whole walk can't bend it. The
vertical is the mean of each recording's own. Both count a recording once: its errors are the phone's, and more
frames of it don't make them smaller.
"""

from dataclasses import dataclass

import numpy as np

from alignment.segments import Segment, windows
from artefacts import UserError
from geometry import GeometryError
from geometry.fits import Sim3, direction_angles, fit_robust, fit_sim3, mean_direction
from geometry.poses import Array

# Residuals that nobody minds, where a robust fit stops telling items apart.
_WINDOW_FLOOR = 2e-3  # of the window's extent: 2 mm a metre
_SCALE_FLOOR = 1e-3  # of a window's scale against its session's
_UP_FLOOR = np.radians(0.2)  # of a frame's vertical against its recording's
_RECORDING_FLOOR = 4.0  # sigmas, of a recording against the others


@dataclass(frozen=True)
class Scale:
    """VIO metres per SfM unit of one recording: natural logarithm, its sigma, and the windows behind it."""

    log: float
    sd: float
    windows: int


@dataclass(frozen=True)
class MapScale:
    """Metres per SfM unit by all recordings: logarithm, sigma, each recording's own, and its weight (0 to 1)."""

    log: float
    sd: float
    recordings: dict[str, Scale]
    weights: dict[str, float]


@dataclass(frozen=True)
class Vertical:
    """The map's up (3,) in SfM's axes, sigma of its tilt in radians (per axis), and each recording's own."""

    up_sfm: Array
    sd: float
    recordings: dict[str, Array]


def common_scale(
    segments: list[Segment], *, window_m: float, least_extent_m: float, window_sd: float, phone_sd: float
) -> MapScale:
    """Metres per SfM unit, one robust estimate over all recordings.

    `least_extent_m`: windows whose VIO positions spread less (root mean square) say nothing about scale.
    `window_sd` and `phone_sd`: what a window's and a phone's scale are expected to be off by, as shares; the scatter
    that is found adds to them. Raises UserError where no session moves enough.
    """
    found = {}
    for recording in sorted({s.recording for s in segments}):
        own = [s for s in segments if s.recording == recording]
        scale = _recording_scale(own, window_m, least_extent_m, window_sd)
        if scale is not None:
            found[recording] = scale
    if not found:
        extent = max((_extent(s.vio_T_cam[s.both, :3, 3]) for s in segments if s.both.sum() >= 2), default=0.0)
        raise UserError(
            "the map's metric scale can't be had: no session moves enough",
            where="frames that have both an SfM and a VIO pose",
            expected=f"3 or more such frames in a row, spread over {least_extent_m:g} m or more (root mean square)",
            found=f"{sum(int(s.both.sum()) for s in segments)} such frames, spread over {extent:.3g} m at most",
            do="capture with more walking, or lower align.least_extent_m",
        )
    logs = np.array([s.log for s in found.values()])
    sds = np.array([np.hypot(s.sd, phone_sd) for s in found.values()])
    mean, robust = _robust_mean(logs, sds**-2, sds)
    weight = robust * sds**-2
    # Scatter beyond what each sigma says is the phones' doing.
    excess = max(1.0, float(np.sum(weight * ((logs - mean) / sds) ** 2) / np.sum(weight)))
    sd = float(np.sqrt(excess * np.sum((weight * sds) ** 2)) / weight.sum())
    return MapScale(mean, sd, found, dict(zip(found, robust.tolist(), strict=True)))


def common_vertical(segments: list[Segment], *, phone_sd: float) -> Vertical:
    """The direction of up in SfM's axes: the robust mean of each recording's own.

    `phone_sd`: expected error of one recording's vertical in radians (per axis); the scatter that is found adds to it.
    Raises UserError where no frame has both gravity and an SfM pose.
    """
    own: dict[str, Array] = {}
    for recording in sorted({s.recording for s in segments}):
        ups = np.concatenate([_ups(s) for s in segments if s.recording == recording])
        if len(ups):
            own[recording], _ = _robust_direction(ups, _UP_FLOOR)
    if not own:
        raise UserError(
            "the map's vertical can't be had: no registered frame has a gravity vector",
            where="import.frames, gravity_x/y/z",
            expected="gravity or VIO poses for some of the registered frames",
            do="use a capture format with phone poses",
        )
    ups = np.stack(list(own.values()))
    up, robust = _robust_direction(ups, _RECORDING_FLOOR * phone_sd)
    angles = direction_angles(ups, up)
    # Two axes of tilt an angle; one prior observation of each keeps few recordings from looking certain.
    variance = (np.sum(robust * angles**2) + 2 * phone_sd**2) / (2 * robust.sum())
    return Vertical(up, float(np.sqrt(variance / robust.sum())), own)


def _recording_scale(segments: list[Segment], window_m: float, least_extent_m: float, window_sd: float) -> Scale | None:
    logs, spreads = [], []
    for segment in segments:
        known = segment.where(segment.both)
        if len(known.rows) < 3:
            continue
        for inside in windows(known, window_m):
            sfm, vio = known.sfm_T_cam[inside, :3, 3], known.vio_T_cam[inside, :3, 3]
            if len(inside) < 3 or _extent(vio) < least_extent_m:
                continue
            scale, weights = _window_scale(sfm, vio)
            logs.append(-np.log(scale))
            spreads.append(_extent(vio, weights) ** 2)
    if not logs:
        return None
    log, spread = np.array(logs), np.array(spreads)
    mean, robust = _robust_mean(log, spread, np.ones(len(log)), floor=_SCALE_FLOOR)
    weight = robust * spread
    # Each window shares half its path with the next one: together they count for half as many.
    effective = max(1.0, float(weight.sum() ** 2 / np.sum(weight**2)) / (2 if len(log) > 1 else 1))
    scatter = float(np.sum(weight * (log - mean) ** 2) / weight.sum())
    variance = (effective * scatter + window_sd**2) / effective
    return Scale(mean, float(np.sqrt(variance / effective)), len(log))


def _window_scale(sfm: Array, vio: Array) -> tuple[float, Array]:
    """SfM units per VIO metre of one window, and the frames' weights: wrong SfM poses have none.

    SfM is fitted to, as its wrong poses are gross; as the side that is fitted from they'd be leverage points. A turn
    about a straight path isn't determined and doesn't matter here.
    """
    size = _extent(vio)

    def residuals(sfm_S_vio: Sim3) -> Array:
        return np.linalg.norm(sfm - sfm_S_vio.points(vio), axis=1) / (sfm_S_vio.scale * size)

    try:
        sfm_S_vio, weights = fit_robust(
            lambda w: fit_sim3(sfm, vio, w, line_ok=True), residuals, len(sfm), floor=_WINDOW_FLOOR
        )
    except GeometryError as error:
        raise UserError(
            "SfM puts frames in one place that VIO says are apart",
            found=str(error),
            do="look at the sfm recording; its model is collapsed there",
        ) from error
    return sfm_S_vio.scale, weights


def _robust_mean(values: Array, weights: Array, sds: Array, floor: float = _RECORDING_FLOOR) -> tuple[float, Array]:
    """Robust weighted mean of numbers, residuals counted in their `sds`."""
    mean, robust = fit_robust(
        lambda w: float(np.average(values, weights=w)),
        lambda mean: np.abs(values - mean) / sds,
        len(values),
        floor=floor,
        weights=weights,
    )
    return mean, robust


def _robust_direction(directions: Array, floor: float) -> tuple[Array, Array]:
    return fit_robust(
        lambda w: mean_direction(directions, w),
        lambda mean: direction_angles(directions, mean),
        len(directions),
        floor=floor,
    )


def _ups(segment: Segment) -> Array:
    known = segment.registered & np.isfinite(segment.up_cam).all(axis=1)
    return np.einsum("nij,nj->ni", segment.sfm_T_cam[known, :3, :3], segment.up_cam[known])


def _extent(xyz: Array, weights: Array | None = None) -> float:
    """Root mean square distance of points (N, 3) from their mean."""
    mean = np.average(xyz, axis=0, weights=weights)
    return float(np.sqrt(np.average(np.sum((xyz - mean) ** 2, axis=1), weights=weights)))
