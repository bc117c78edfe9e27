"""Two trajectories of the same frames, and the length, windows and steps of a path."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array

# Frames that a window needs so that a robust fit of 7 unknowns sees which of them is wrong.
_MIN_FRAMES = 6


class TrajectoryPair(NamedTuple):
    """The poses of n frames that SfM and VIO both have, in order of time, without VIO jumps between them: `sfm_T_cam`
    (n, 4, 4) in a model's arbitrary scale, `vio_T_cam` (n, 4, 4) in metres; `travelled_m` (n,) along VIO's path, in
    which frames that SfM lacks count, too."""

    sfm_T_cam: Array
    vio_T_cam: Array
    travelled_m: Array


def path_windows(travelled_m: Array, length_m: float) -> list[NDArray[np.intp]]:
    """Indices (k,) of the frames in windows of `length_m` of a path, each half over the next; `travelled_m` (n,) is how
    far along it each frame lies.

    The windows are spread so that the last one ends with the path; a shorter path is one window. Where frames are far
    apart a window is longer, so that it has six frames; a path of fewer is one window.
    """
    count = len(travelled_m)
    total_m = float(travelled_m[-1])
    steps = 0 if total_m <= length_m else int(np.ceil((total_m - length_m) / (length_m / 2)))
    starts = np.linspace(0.0, max(total_m - length_m, 0.0), steps + 1)
    # Rounding must not cost a window its last frame.
    slack = 1e-9 * (1 + total_m)
    first = np.searchsorted(travelled_m, starts - slack)
    last = np.searchsorted(travelled_m, starts + length_m + slack, side="right")
    last = np.minimum(np.maximum(last, first + _MIN_FRAMES), count)
    first = np.maximum(np.minimum(first, last - _MIN_FRAMES), 0)
    return [np.arange(a, b) for a, b in dict.fromkeys(zip(first.tolist(), last.tolist(), strict=True))]


def path_steps(travelled_m: Array, step_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last frames of steps of `step_m` of a path, or a little more, one after the other; the last one may be
    shorter. `travelled_m` (n,) is how far along it each frame lies."""
    ends = [0]
    while ends[-1] + 1 < len(travelled_m):
        following = int(np.searchsorted(travelled_m, travelled_m[ends[-1]] + step_m))
        ends.append(min(max(following, ends[-1] + 1), len(travelled_m) - 1))
    return np.array(ends[:-1], np.intp), np.array(ends[1:], np.intp)
