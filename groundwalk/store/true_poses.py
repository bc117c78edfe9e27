"""The poses that the simulator had: for whoever judges a stage's result; no stage makes its own of them."""

import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.store.errors import UserError
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.simulated import TRUE_POSES
from groundwalk.store.tables import poses_of, read_table, table_of


def true_poses_of(frames: pd.DataFrame, scene: str, profile: str, root: DataRoot) -> Array:
    """map_T_cam (N, 4, 4) of a simulated scene's frames (columns session_id, t_ns), by the simulator; NaN where it has
    none."""
    path = root.captures(scene) / TRUE_POSES
    if not path.is_file():
        raise UserError(
            f"scene {scene} has no true poses",
            where=path,
            expected="the simulator's true_poses.parquet",
            do="this check is for simulated scenes",
        )
    sessions = table_of(root.run(profile, scene), "import", "sessions")
    recording = dict(zip(sessions["session_id"], sessions["recording"], strict=True))
    keys = pd.DataFrame({"session_id": frames["session_id"].map(recording), "t_ns": frames["t_ns"]})
    truth = read_table(path, schema("simulate", "true_poses"))
    return poses_of(keys.merge(truth, on=["session_id", "t_ns"], how="left", validate="many_to_one"), "map_cam")
