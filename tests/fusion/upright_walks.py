"""Walks for the fusion tests whose odometry drifts in yaw and position only, as a phone's does."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation


def upright_walk(
    seed: int, frames: int = 200, noise_m: float = 0.5, noise_deg: float = 3.0, outliers: float = 0.2
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Times, true poses, odometry (yaw and position drift) and predictions whose errors neighbours share."""
    rng = np.random.default_rng(seed)
    t_ns = np.arange(frames, dtype=np.int64) * 10**9
    heading = np.cumsum(rng.normal(0, 0.2, frames))
    position = np.cumsum(np.stack([np.sin(heading), rng.normal(0, 0.02, frames), np.cos(heading)], 1), axis=0)
    truth = make_pose(yaw_rotation(heading), position)
    yaw = rng.uniform(-3, 3) + np.cumsum(rng.normal(0, np.radians(0.05), frames))
    offset = rng.normal(0, 20, 3) + np.cumsum(rng.normal(0, 0.01, (frames, 3)), axis=0)
    vio_T_map = make_pose(yaw_rotation(yaw), offset)
    shared = np.zeros((frames, 6))
    for i in range(1, frames):
        shared[i] = 0.8 * shared[i - 1] + 0.6 * rng.normal(size=6)
    error = 0.7 * shared + 0.7 * rng.normal(size=(frames, 6))
    error *= np.where(rng.random(frames) < outliers, 8.0, 1.0)[:, None]
    turn = Rotation.from_rotvec(np.radians(noise_deg) * error[:, 3:]).as_matrix()
    apr = make_pose(turn @ truth[:, :3, :3], position + noise_m * error[:, :3])
    return t_ns, truth, vio_T_map @ truth, apr


def as_walk(t_ns: NDArray[np.int64], truth: Array, vio: Iterable[Array | None], apr: Iterable[Array | None]) -> Walk:
    """The same as a `Walk`; a pose that is None or NaN is missing."""
    none = np.full((4, 4), np.nan)
    count = len(t_ns)
    vio, apr = (np.array([none if p is None else p for p in poses]) for poses in (vio, apr))
    frame_id = np.array([f"s/{i:06d}" for i in range(count)], dtype=object)
    return Walk("scene", "s", "test", frame_id, np.asarray(t_ns), np.full((count, 3), np.nan), vio, apr, truth)
