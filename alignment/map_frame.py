"""The map frame: metric and +y up from all VIO sessions together, without leaning on VIO positions over distance.

Scale compares SfM and VIO step by step, so that VIO's drift over a whole walk can't bend it. The
vertical is the mean over recordings. Both count a recording once: its errors are the phone's, and more
frames of it don't make them smaller.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from groundwalk.alignment.segments import Segment
from groundwalk.consistency.scale import Scale, recording_scale, robust_mean
from groundwalk.geometry.fits import direction_angles, fit_robust, mean_direction
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import ScaleSource, VerticalSource

# Residuals below which a robust fit no longer tells items apart.
_UP_FLOOR = np.radians(0.2)  # of a frame's vertical against its recording's
_RECORDING_FLOOR = 4.0  # sigmas, of a recording against the others
_OTHER_WORLD = np.radians(5.0)  # no error of a phone's gravity
# Neighbouring frames' gravity has the same error: so many parts of a recording count as independent.
_PARTS = 8


@dataclass(frozen=True)
class MapScale:
    """Metres per SfM unit by all recordings: logarithm, standard error (NaN: unknown, the unit stays SfM's), and each
    recording's scale. `rulers` names the rulers that logarithm and standard error are by instead, where there are any;
    `reference` says that they are by reference poses."""

    log: float
    sd: float
    recordings: dict[str, Scale]
    rulers: tuple[str, ...] = ()
    reference: ScaleSource | None = None

    @property
    def is_known(self) -> bool:
        """The map is metric."""
        return bool(np.isfinite(self.sd)) and self.reference is not ScaleSource.REFERENCE_UNIT_UNKNOWN

    def source(self, max_sd: float) -> str:
        """What gives it, as tables have it; above a standard error of `max_sd` it is called uncertain."""
        if not self.is_known:
            return self.reference or ScaleSource.NONE
        by = f"ruler: {', '.join(self.rulers)}" if self.rulers else self.reference or ScaleSource.VIO
        return by if self.sd <= max_sd else f"{by}, uncertain"


NO_SCALE = MapScale(0.0, float("nan"), {})


@dataclass(frozen=True)
class RecordingVertical:
    """A recording's up (3,) in SfM's axes, and the standard error of its mean, radians per axis."""

    up_sfm: Array
    sd: float


@dataclass(frozen=True)
class Vertical:
    """The map's up (3,) in SfM's axes, standard error of its tilt in radians (per axis), each recording's vertical, and
    what gives it. Where nothing does, up is any direction, and the standard error NaN. `is_agreed`: most recordings
    have it, so that one that has another is wrong."""

    up_sfm: Array
    sd: float
    recordings: dict[str, RecordingVertical]
    source: VerticalSource = VerticalSource.GRAVITY
    is_agreed: bool = True


def common_scale(segments: list[Segment], *, step_m: float, step_sd: float, phone_sd: float) -> MapScale:
    """Metres per SfM unit, one robust estimate over all recordings; unknown where no recording moves enough.

    `step_m`: VIO path over which steps are compared, at most. `step_sd` and `phone_sd`: what the scale of a step of a
    metre and of a phone are expected to be off by, as fractions; the observed scatter adds to them. Raises
    GeometryError where SfM puts frames in one place that VIO says are apart.
    """
    scales = {}
    for recording in sorted({s.recording for s in segments}):
        parts = [s.trajectory_pair for s in segments if s.recording == recording]
        scale = recording_scale(parts, step_m=step_m, step_sd=step_sd)
        if scale is not None:
            scales[recording] = scale
    if not scales:
        return NO_SCALE
    logs = np.array([s.log for s in scales.values()])
    sds = np.array([np.hypot(s.sd, phone_sd) for s in scales.values()])
    mean, robust = robust_mean(logs, sds**-2, sds, _RECORDING_FLOOR)
    weight = robust * sds**-2
    # Scatter beyond each standard error is of the phones.
    excess = max(1.0, float(np.sum(weight * ((logs - mean) / sds) ** 2) / np.sum(weight)))
    sd = float(np.sqrt(excess * np.sum((weight * sds) ** 2)) / weight.sum())
    return MapScale(mean, sd, scales)


def common_vertical(
    segments: list[Segment], *, phone_sd: float, max_tilt: float, tested: Collection[str] = ()
) -> Vertical:
    """The direction of up in SfM's axes: the robust mean over recordings, or over those of them that are `tested`,
    whose gravity the images confirm. Unknown where no frame has both gravity and an SfM pose, and where recordings are
    of different worlds and nothing tells which is upright. `max_tilt`: beyond, radians, a recording has another one.

    `phone_sd`: expected error of one recording's vertical in radians (per axis); the observed scatter adds to it.
    """
    verticals: dict[str, RecordingVertical] = {}
    for recording in sorted({s.recording for s in segments}):
        ups = np.concatenate([_ups(s) for s in segments if s.recording == recording])
        if len(ups):
            verticals[recording] = _recording_vertical(ups, phone_sd)
    unknown = Vertical(np.array([0.0, 1.0, 0.0]), np.nan, verticals, VerticalSource.NONE)
    if not verticals:
        return unknown
    deciding = verticals.keys() & set(tested) or verticals.keys()
    ups = np.stack([verticals[recording].up_sfm for recording in sorted(deciding)])
    up, robust = _robust_direction(ups, _RECORDING_FLOOR * phone_sd)
    angles = direction_angles(ups, up)
    if 2 * np.sum(angles <= max(max_tilt, _OTHER_WORLD)) <= len(angles):
        return replace(unknown, is_agreed=False)
    is_agreed = bool(2 * np.sum(angles <= max_tilt) > len(angles))
    # Two axes of tilt an angle; one prior observation of each keeps few recordings from looking certain.
    variance = (np.sum(robust * angles**2) + 2 * phone_sd**2) / (2 * robust.sum())
    return Vertical(up, float(np.sqrt(variance / robust.sum())), verticals, is_agreed=is_agreed)


def _recording_vertical(ups: Array, phone_sd: float) -> RecordingVertical:
    """From the up vectors (n, 3) of its frames in order; the standard error by the scatter of its parts, or `phone_sd`
    where there are no two."""
    up, _ = _robust_direction(ups, _UP_FLOOR)
    parts = [_robust_direction(part, _UP_FLOOR)[0] for part in np.array_split(ups, min(_PARTS, len(ups)))]
    if len(parts) < 2:
        return RecordingVertical(up, phone_sd)
    squares = np.sum(direction_angles(np.stack(parts), up) ** 2)
    return RecordingVertical(up, float(np.sqrt(squares / 2 / (len(parts) - 1) / len(parts))))


def _robust_direction(directions: Array, floor: float) -> tuple[Array, Array]:
    return fit_robust(
        lambda w: mean_direction(directions, w),
        lambda mean: direction_angles(directions, mean),
        len(directions),
        floor=floor,
    )


def _ups(segment: Segment) -> Array:
    has_up = segment.registered & np.isfinite(segment.up_cam).all(axis=1)
    return np.einsum("nij,nj->ni", segment.sfm_T_cam[has_up, :3, :3], segment.up_cam[has_up])
