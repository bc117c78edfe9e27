"""Reference poses of frames, and what is known of their unit and vertical."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.store.choices import LengthUnit, UpAxis
from groundwalk.store.tables import poses_of


@dataclass(frozen=True)
class Reference:
    """Stated poses map_T_cam (N, 4, 4) of the rows of the frames table, NaN where there is none; whether their unit is
    the metre, and whether their +y is up. `gives_map`: no frame has VIO, so that the map is the reference's frame;
    `origin` (3,) is where its origin is in the data set's own coordinates."""

    map_T_cam: Array
    is_metric: bool
    is_up_known: bool
    gives_map: bool
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @staticmethod
    def of(frames: pd.DataFrame, reference: pd.DataFrame, sessions: pd.DataFrame) -> "Reference | None":
        """From import's tables; None where no frame has a reference pose."""
        map_T_cam = poses_of(reference.set_index("frame_id").reindex(frames["frame_id"]), "map_cam")
        has_pose = np.isfinite(map_T_cam[:, 0, 0])
        if not has_pose.any():
            return None
        referenced = sessions[sessions["session_id"].isin(set(frames["session_id"][has_pose]))]
        x, y, z = (float(referenced[f"reference_origin_{axis}"].iloc[0]) for axis in "xyz")
        is_metric = bool((referenced["reference_unit"] == LengthUnit.METRE).all())
        is_up_known = bool((referenced["up"] == UpAxis.Y).all())
        return Reference(map_T_cam, is_metric, is_up_known, bool(frames["vio_cam_tx"].isna().all()), (x, y, z))

    def where(self, mask: np.ndarray) -> "Reference":
        """The rows for which `mask` (N,) holds."""
        return replace(self, map_T_cam=self.map_T_cam[mask])

    @property
    def extent(self) -> float:
        """Diagonal of the box around the camera positions, in the reference's unit."""
        return extent_of(self.map_T_cam[np.isfinite(self.map_T_cam[:, 0, 0])])


def extent_of(world_T_cam: Array) -> float:
    """Diagonal of the box around the positions of poses (N, 4, 4)."""
    return float(np.linalg.norm(np.ptp(world_T_cam[:, :3, 3], axis=0)))
