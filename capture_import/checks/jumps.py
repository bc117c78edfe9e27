"""Jumps of a phone's odometry: steps that no hand does, at which a session may have to end."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Jump
from groundwalk.geometry.poses import Array

# A jump is motion that no hand does: beyond what an acceleration of 4 m/s^2 or 600 deg/s^2 changes between two poses,
# beyond the noise of a pose, and far beyond what the same hand does around that moment.
_ACCELERATION_M_S2 = 4.0
_ACCELERATION_DEG_S2 = 600.0
_NOISE_M = 0.03
_NOISE_DEG = 3.0
_MIN_RATIO = 8.0
_CONTEXT = 4
_MEDIAN_STEPS = 60
# At larger ones a session ends: sfm and align hold VIO to a few centimetres over such a step.
_SPLIT_M, _SPLIT_DEG = 0.5, 15.0


def find_jumps(t_ns: NDArray[np.int64], poses: Array) -> list[Jump]:
    """Steps between poses (N, 4, 4) at rising times (N,) that no hand can do.

    Each step is compared with the motion that the steps around it extrapolate (their median velocity, so that one
    neighbouring jump doesn't matter); the residual must be explained by acceleration, pose noise, or the median
    residual in the neighbourhood.
    """
    if len(poses) < 4:
        return []
    dt: Array = np.diff(t_ns).astype(float) * 1e-9
    velocity = np.diff(poses[:, :3, 3], axis=0) / dt[:, None]
    # Rotation in the world's axes, so that neighbouring steps can be averaged.
    steps = poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2)
    rate = np.degrees(Rotation.from_matrix(steps).as_rotvec()) / dt[:, None]
    beyond_m = _beyond_context(velocity, dt)
    beyond_deg = _beyond_context(rate, dt)
    usual_m, usual_deg = (median_filter(b, size=_MEDIAN_STEPS + 1, mode="nearest") for b in (beyond_m, beyond_deg))
    limit_m = np.maximum(_NOISE_M + _ACCELERATION_M_S2 * dt**2, _MIN_RATIO * usual_m)
    limit_deg = np.maximum(_NOISE_DEG + _ACCELERATION_DEG_S2 * dt**2, _MIN_RATIO * usual_deg)
    jumps = np.flatnonzero((beyond_m > limit_m) | (beyond_deg > limit_deg))
    splits = (beyond_m > _SPLIT_M) | (beyond_deg > _SPLIT_DEG)
    return [
        Jump(int(i) + 1, int(t_ns[i + 1]), float(dt[i]), float(beyond_m[i]), float(beyond_deg[i]), bool(splits[i]))
        for i in jumps
    ]


def _beyond_context(rate_N3: Array, dt: Array) -> Array:
    """Per step: the length of its change beyond what the median rate of the steps around it predicts."""
    padded = np.pad(rate_N3, ((_CONTEXT, _CONTEXT), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _CONTEXT + 1, axis=0)
    around = np.delete(windows, _CONTEXT, axis=-1)
    beyond: Array = np.linalg.norm(rate_N3 - np.nanmedian(around, axis=-1), axis=-1) * dt
    return beyond
