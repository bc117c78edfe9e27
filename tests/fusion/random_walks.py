"""Random walks for the fusion tests: odometry, predictions with outliers, gaps, jumps and dropouts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose


@dataclass
class RandomWalk:
    t_ns: NDArray[np.int64]  # (N,)
    map_T_cam: Array  # (N, 4, 4) true poses
    vio: list[Array | None]
    apr: list[Array | None]


def random_walk(seed: int, frames: int = 40) -> RandomWalk:
    """A walk of mixed difficulty: some seeds nearly clean, some hopeless."""
    rng = np.random.default_rng(seed)
    step_s = rng.choice([0.9, 1.0, 1.1, 1.4, 1.7, 0.4], size=frames, p=[0.1, 0.7, 0.1, 0.04, 0.04, 0.02])
    t_ns = np.cumsum(np.round(step_s * 1e9)).astype(np.int64)
    position = np.cumsum(rng.normal(0, 0.5, (frames, 3)) * [1, 0.1, 1], axis=0) + rng.normal(0, 6, 3)
    rotation = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.15, (frames, 3)), axis=0))
    map_T_cam = make_pose(rotation.as_matrix(), position)

    drift_m, drift_rad = rng.choice([0.0, 0.02, 0.2]), rng.choice([0.0, 0.003, 0.03])
    vio_from_map = Rotation.random(rng=rng)
    wander = Rotation.from_rotvec(np.cumsum(rng.normal(0, drift_rad, (frames, 3)), axis=0))
    vio_position = vio_from_map.apply(position) + np.cumsum(rng.normal(0, drift_m, (frames, 3)), axis=0)
    vio_position[int(rng.integers(frames)) :] += rng.choice([0.0, 0.0, 5.0])  # a jump in one walk of three
    vio = make_pose((wander * vio_from_map * rotation).as_matrix(), vio_position)

    noise_m, noise_rad = rng.choice([0.0, 0.05, 0.15]), rng.choice([0.0, 0.01, 0.03])
    apr_position = position + rng.normal(0, noise_m, (frames, 3))
    apr_rotation = rotation * Rotation.from_rotvec(rng.normal(0, noise_rad, (frames, 3)))
    outlier = rng.random(frames) < rng.choice([0.0, 0.1, 0.4])
    apr_position[outlier] += rng.normal(0, 3, (int(outlier.sum()), 3))
    apr = make_pose(apr_rotation.as_matrix(), apr_position)

    lost = rng.choice([0.0, 0.05])
    return RandomWalk(
        t_ns,
        map_T_cam,
        [None if rng.random() < lost else p for p in vio],
        [None if rng.random() < lost else p for p in apr],
    )
