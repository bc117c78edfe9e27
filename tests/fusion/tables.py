"""Random walks as the three tables that an evaluation reads."""

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import inverse, make_pose, yaw_rotation
from groundwalk.store.tables import pose_frame
from tests.fusion.random_walks import random_walk

Tables = tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]
"""Frames, ground truth and predictions."""


def tables(seeds: list[int], models: tuple[str, ...] = ("PN",), frames: int = 40) -> Tables:
    """Those of one test session a seed."""
    parts: dict[str, list[pd.DataFrame]] = {"frames": [], "truth": [], "predictions": []}
    for seed in seeds:
        walk = random_walk(seed, frames)
        keys = pd.DataFrame(
            {
                "frame_id": [f"s{seed}/{i:06d}" for i in range(frames)],
                "session_id": f"s{seed}",
                "split": "test",
                "t_ns": walk.t_ns,
                "support": False,
            }
        )
        none = np.full((4, 4), np.nan)
        vio, apr = (np.array([none if p is None else p for p in poses]) for poses in (walk.vio, walk.apr))
        # Odometry's +y is up, as the map's: turned about it, and somewhere else.
        first = next(i for i, pose in enumerate(walk.vio) if pose is not None)
        vio_T_map = make_pose(yaw_rotation(np.array(1.0)), np.array([3.0, 1.0, -2.0]))
        vio = vio_T_map @ walk.map_T_cam[first] @ inverse(vio[first]) @ vio
        parts["frames"].append(pd.concat([keys, pose_frame("vio_cam", vio)], axis=1))
        parts["truth"].append(pd.concat([keys, pose_frame("map_cam", walk.map_T_cam)], axis=1))
        for model in models:
            parts["predictions"].append(pd.concat([keys.assign(model=model), pose_frame("map_cam", apr)], axis=1))
    frames_table, truth, predictions = (pd.concat(p, ignore_index=True) for p in parts.values())
    return frames_table, truth, predictions
