"""The map frame: metric and +y up from all VIO sessions together, without leaning on VIO positions over distance.

Scale compares SfM and VIO step by step, so that VIO's drift over a whole walk can't bend it. The
vertical is the mean over recordings. Both count a recording once: its errors are the phone's, and more
frames of it don't make them smaller.
"""

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np

from groundwalk.alignment.components import NO_SCALE, MapScale, RecordingVertical, Vertical
from groundwalk.alignment.segments import Segment
from groundwalk.consistency.scale import recording_scale, robust_mean
from groundwalk.geometry.fits import direction_angles, fit_robust, mean_direction
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import VerticalSource

# What the scale and the gravity of one recording are expected to be off by, as a fraction and in radians an axis:
# ARKit's of real sessions differ by as much (docs/results/real.md). Observed scatter adds to them.
_PHONE_SCALE_SD, _PHONE_TILT_SD = 0.003, float(np.radians(0.3))
# Residuals below which a robust fit no longer tells items apart.
_UP_FLOOR = np.radians(0.2)  # of a frame's vertical against its recording's
_RECORDING_FLOOR = 4.0  # sigmas, of a recording against the others
_OTHER_WORLD = np.radians(5.0)  # no error of a phone's gravity
# Neighbouring frames' gravity has the same error: so many stretches of a recording count as independent.
_STRETCHES = 8


def common_scale(segments: list[Segment]) -> MapScale:
    """Metres per SfM unit, one robust estimate over all recordings; unknown where no recording moves enough. Raises
    GeometryError where SfM puts frames in one place that VIO says are apart."""
    scales = {}
    for recording in sorted({s.recording for s in segments}):
        pairs = [s.trajectory_pair for s in segments if s.recording == recording]
        scale = recording_scale(pairs)
        if scale is not None:
            scales[recording] = scale
    if not scales:
        return NO_SCALE
    logs = np.array([s.log for s in scales.values()])
    sds = np.array([np.hypot(s.sd, _PHONE_SCALE_SD) for s in scales.values()])
    mean, robust = robust_mean(logs, sds**-2, sds, _RECORDING_FLOOR)
    weight = robust * sds**-2
    # Scatter beyond each standard error is of the phones.
    excess = max(1.0, float(np.sum(weight * ((logs - mean) / sds) ** 2) / np.sum(weight)))
    sd = float(np.sqrt(excess * np.sum((weight * sds) ** 2)) / weight.sum())
    return MapScale(mean, sd, scales)


def common_vertical(segments: list[Segment], *, max_tilt: float, tested: Collection[str] = ()) -> Vertical:
    """The direction of up in SfM's axes: the robust mean over recordings, or over those of them that are `tested`,
    whose gravity the images confirm. Unknown where no frame has both gravity and an SfM pose, and where recordings are
    of different worlds and nothing tells which is upright. `max_tilt`: beyond, radians, a recording has another one.
    """
    verticals: dict[str, RecordingVertical] = {}
    for recording in sorted({s.recording for s in segments}):
        of_recording = [s.where(s.registered) for s in segments if s.recording == recording]
        up_sfm = [np.einsum("nij,nj->ni", s.sfm_T_cam[:, :3, :3], s.up_cam) for s in of_recording]
        ups = np.concatenate([up[np.isfinite(up).all(axis=1)] for up in up_sfm])
        if len(ups):
            verticals[recording] = _recording_vertical(ups)
    unknown = Vertical(np.array([0.0, 1.0, 0.0]), np.nan, verticals, VerticalSource.NONE)
    if not verticals:
        return unknown
    deciding = verticals.keys() & set(tested) or verticals.keys()
    ups = np.stack([verticals[recording].up_sfm for recording in sorted(deciding)])
    up, robust = _robust_direction(ups, _RECORDING_FLOOR * _PHONE_TILT_SD)
    angles = direction_angles(ups, up)
    if 2 * np.sum(angles <= max(max_tilt, _OTHER_WORLD)) <= len(angles):
        return replace(unknown, is_agreed=False)
    is_agreed = bool(2 * np.sum(angles <= max_tilt) > len(angles))
    # Two axes of tilt an angle; one prior observation of each keeps few recordings from looking certain.
    variance = (np.sum(robust * angles**2) + 2 * _PHONE_TILT_SD**2) / (2 * robust.sum())
    return Vertical(up, float(np.sqrt(variance / robust.sum())), verticals, is_agreed=is_agreed)


def _recording_vertical(ups: Array) -> RecordingVertical:
    """From the up vectors (n, 3) of its frames in order; the standard error by the scatter of its stretches, or a
    phone's where there are no two."""
    up, _ = _robust_direction(ups, _UP_FLOOR)
    means = [_robust_direction(stretch, _UP_FLOOR)[0] for stretch in np.array_split(ups, min(_STRETCHES, len(ups)))]
    if len(means) < 2:
        return RecordingVertical(up, _PHONE_TILT_SD)
    squares = np.sum(direction_angles(np.stack(means), up) ** 2)
    return RecordingVertical(up, float(np.sqrt(squares / 2 / (len(means) - 1) / len(means))))


def _robust_direction(directions: Array, floor: float) -> tuple[Array, Array]:
    fit, residuals = partial(mean_direction, directions), partial(direction_angles, directions)
    return fit_robust(fit, residuals, len(directions), floor=floor)
