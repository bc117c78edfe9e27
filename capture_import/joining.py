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
    if not poses:
        return _numbered(images)
    poses = sorted(poses, key=lambda row: row.t_ns)
    times = np.array([row.t_ns for row in poses], dtype=np.int64)
    joined: list[RawFrame] = []
    joined_poses = set()
    for image in images:
        at = int(np.searchsorted(times, image.t_ns))
        near = min((i for i in (at - 1, at) if 0 <= i < len(poses)), key=lambda i: abs(int(times[i]) - image.t_ns))
        if abs(int(times[near]) - image.t_ns) <= _SAME_NS and near not in joined_poses:
            joined_poses.add(near)
            joined.append(replace(image, vio_T_cam=poses[near].vio_T_cam, tracking=poses[near].tracking))
        else:
            joined.append(image)
    return _numbered([*joined, *(row for i, row in enumerate(poses) if i not in joined_poses)])


def _numbered(rows: Sequence[RawFrame]) -> list[RawFrame]:
    return [replace(row, number=i) for i, row in enumerate(sorted(rows, key=lambda row: row.t_ns))]
