"""The map frame: metric and +y up from all VIO sessions together, without leaning on VIO positions over distance.

Scale compares SfM and VIO step by step, so that VIO's drift over a whole walk can't bend it. The
vertical is the mean of each recording's own. Both count a recording once: its errors are the phone's, and more
frames of it don't make them smaller.
"""

from dataclasses import dataclass

import numpy as np

from alignment.segments import Segment
from artefacts import UserError
from geometry import GeometryError
from geometry.fits import direction_angles, fit_robust, mean_direction
from geometry.poses import Array
from geometry.vio_agreement import Scale, path_m, recording_scale, robust_mean

# What gave the map its scale or vertical, as align.ground_truth names it; rulers go by their names.
BY_VIO, BY_GRAVITY, BY_REFERENCE = "vio", "gravity", "reference"
BY_REFERENCE_UNIT_UNKNOWN, BY_REFERENCE_UP_UNKNOWN = "reference, unit unknown", "reference, up unknown"

# Residuals that nobody minds, where a robust fit stops telling items apart.
_UP_FLOOR = np.radians(0.2)  # of a frame's vertical against its recording's
_RECORDING_FLOOR = 4.0  # sigmas, of a recording against the others


@dataclass(frozen=True)
class MapScale:
    """Metres per SfM unit by all recordings: logarithm, sigma, each recording's own, and its weight (0 to 1). `rulers`
    names the rulers that logarithm and sigma are by instead, where there are any; `reference` says that they are by
    reference poses, BY_REFERENCE or BY_REFERENCE_UNIT_UNKNOWN."""

    log: float
    sd: float
    recordings: dict[str, Scale]
    weights: dict[str, float]
    rulers: tuple[str, ...] = ()
    reference: str = ""

    @property
    def source(self) -> str:
        """What gives it, as align.ground_truth names it."""
        return f"ruler: {', '.join(self.rulers)}" if self.rulers else self.reference or BY_VIO


@dataclass(frozen=True)
class Vertical:
    """The map's up (3,) in SfM's axes, sigma of its tilt in radians (per axis), and each recording's own. `source`:
    what gives it, as align.ground_truth names it."""

    up_sfm: Array
    sd: float
    recordings: dict[str, Array]
    source: str = BY_GRAVITY


def common_scale(
    segments: list[Segment], *, step_m: float, least_step_m: float, step_sd: float, phone_sd: float
) -> MapScale:
    """Metres per SfM unit, one robust estimate over all recordings.

    `step_m`: VIO path over which steps are compared. `least_step_m`: steps that VIO moved less say nothing about scale.
    `step_sd` and `phone_sd`: what the scale of a step of a metre and of a phone are expected to be off by, as shares;
    the scatter that is found adds to them. Raises UserError where no session moves enough.
    """
    found = {}
    for recording in sorted({s.recording for s in segments}):
        own = [s for s in segments if s.recording == recording]
        scale = _recording_scale(own, step_m, least_step_m, step_sd)
        if scale is not None:
            found[recording] = scale
    if not found:
        walked = max((float(path_m(s.vio_T_cam[s.both])[-1]) for s in segments if s.both.any()), default=0.0)
        raise UserError(
            "the map's metric scale can't be had: no session moves enough",
            where="frames that have both an SfM and a VIO pose",
            expected=f"3 or more such frames in a row, {least_step_m:g} m or more from first to last",
            found=f"{sum(int(s.both.sum()) for s in segments)} such frames, {walked:.3g} m walked at most",
            do="capture with more walking, lower align.least_step_m, or set the scale by a ruler (docs/rulers.md)",
        )
    logs = np.array([s.log for s in found.values()])
    sds = np.array([np.hypot(s.sd, phone_sd) for s in found.values()])
    mean, robust = robust_mean(logs, sds**-2, sds, _RECORDING_FLOOR)
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


def _recording_scale(segments: list[Segment], step_m: float, least_step_m: float, step_sd: float) -> Scale | None:
    stretches = [segment.stretch for segment in segments]
    try:
        return recording_scale(stretches, step_m=step_m, least_step_m=least_step_m, step_sd=step_sd)
    except GeometryError as error:
        raise UserError(
            "SfM puts frames in one place that VIO says are apart",
            found=str(error),
            do="look at the sfm recording; its model is collapsed there",
        ) from error


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
