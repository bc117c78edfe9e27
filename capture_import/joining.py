"""Joining images to poses that are logged apart."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groundwalk.capture_import.capture import RawFrame

# Clocks that were written with microseconds agree to this.
_SAME_NS = 1_000_000


def join_by_time(poses: Sequence[RawFrame], images: Sequence[RawFrame]) -> list[RawFrame]:
    """One log from rows with poses and rows with images, in the order of time, numbered anew.

    An image within a millisecond of a pose becomes one row with it; other images stay without a pose, which is then
    interpolated.
    """
    poses = sorted(poses, key=lambda row: row.t_ns)
    times = np.array([row.t_ns for row in poses], dtype=np.int64)
    joined: list[RawFrame] = []
    joined_poses = set()
    for image in images:
        at = int(np.searchsorted(times, image.t_ns))
        around = [i for i in (at - 1, at) if 0 <= i < len(poses)]
        near = min(around, key=lambda i: abs(int(times[i]) - image.t_ns), default=-1)
        if around and abs(int(times[near]) - image.t_ns) <= _SAME_NS and near not in joined_poses:
            joined_poses.add(near)
            joined.append(replace(image, vio_T_cam=poses[near].vio_T_cam, tracking=poses[near].tracking))
        else:
            joined.append(image)
    rows = [*joined, *(row for i, row in enumerate(poses) if i not in joined_poses)]
    return [replace(row, number=i) for i, row in enumerate(sorted(rows, key=lambda row: row.t_ns))]
