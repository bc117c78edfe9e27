"""A recorded walk, as methods and their evaluation get it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array

Flags = NDArray[np.bool_]
Texts = NDArray[np.object_]


@dataclass(frozen=True)
class Walk:
    """One session's evaluated frames in order of time. A pose that is missing is all NaN.

    frame_id (N,) str, t_ns (N,) int64, gravity (N, 3) unit vectors in camera axes, and the poses (N, 4, 4).
    quality (N,) str: class of the ground truth, None where no class is stated; None instead of the array for all so.
    shares_vertical: odometry's +y and the map's are both up, as far as the tables say.
    predicted_covariance (N, 6, 6): of the predictions' errors in the map frame, rotation (rad) then translation (m),
    NaN where a prediction brings none; None instead of the array where none does.
    """

    scene: str
    session_id: str
    split: str
    frame_id: Texts
    t_ns: NDArray[np.int64]
    gravity: Array
    vio_T_cam: Array
    map_T_cam_predicted: Array
    map_T_cam: Array  # ground truth
    quality: Texts | None = None
    predicted_covariance: Array | None = None
    shares_vertical: bool = True

    def without_odometry(self) -> "Walk":
        """The walk as if tracking were lost all the time."""
        return replace(self, vio_T_cam=np.full_like(self.vio_T_cam, np.nan))

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def has_odometry(self) -> bool:
        """Whether any frame has a pose by odometry; without, there is nothing to fuse predictions with."""
        return bool(known(self.vio_T_cam).any())


def with_odometry(walks: Iterable[Walk]) -> list[Walk]:
    """The walks on which methods that fuse run; on the others predictions stand alone."""
    return [walk for walk in walks if walk.has_odometry]


def known(poses: Array) -> Flags:
    """Which of poses (N, 4, 4) are there, (N,)."""
    return np.asarray(np.isfinite(poses).all(axis=(-1, -2)))
