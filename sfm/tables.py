"""The stage's tables from its arrays."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from artefacts.tables import pose_frame
from geometry.poses import Array
from sfm.mapping import BuiltModel
from sfm.matching import MatchedPairs
from sfm.model import Model


def images_table(
    frame_ids: Sequence[str], model: Model, model_id: str, keypoints_N: NDArray[np.int64], covariance_N66: Array | None
) -> pd.DataFrame:
    """One row a frame; `covariance_N66` NaN for frames that aren't registered."""
    registered = model.registered
    table = pd.DataFrame({"frame_id": frame_ids, "registered": registered})
    table["model_id"] = [model_id if known else None for known in registered]
    table = pd.concat([table, pose_frame("sfm_cam", model.sfm_T_cam)], axis=1)
    table["keypoints"] = keypoints_N
    table["observations"] = model.observations()
    table["reprojection_px"] = model.frame_error_px()
    rows = [None] * len(table) if covariance_N66 is None else covariance_N66.reshape(-1, 36)
    table["covariance"] = pd.Series(
        [list(row) if known and row is not None else None for row, known in zip(rows, registered, strict=True)],
        dtype=object,
    )
    return table


def models_table(built: Sequence[BuiltModel]) -> pd.DataFrame:
    """One row a model."""
    return pd.DataFrame(
        [
            {
                "model_id": told.model_id,
                "attempt": told.attempt,
                "chosen": told.chosen,
                "images": told.images,
                "points": told.points,
                "observations": told.observations,
                "mean_track_length": told.mean_track_length,
                "mean_reprojection_px": told.mean_reprojection_px,
            }
            for told in built
        ]
    )


def pairs_table(frame_ids: Sequence[str], matched: MatchedPairs) -> pd.DataFrame:
    """One row a pair."""
    names = np.asarray(frame_ids, dtype=object)
    return pd.DataFrame(
        {
            "frame_id_a": names[matched.pairs[:, 0]],
            "frame_id_b": names[matched.pairs[:, 1]],
            "origin": matched.origin.astype(object),
            "matches": matched.matches,
            "inliers": matched.inliers,
            "verdict": np.where(matched.verified, "verified", "rejected").astype(object),
        }
    )


def points_table(model: Model) -> pd.DataFrame:
    """One row a point."""
    table = pd.DataFrame({"point_id": model.point_ids})
    table[["x", "y", "z"]] = model.xyz
    table[["r", "g", "b"]] = model.rgb.astype(np.int64)
    table["track_length"] = model.track_lengths()
    table["reprojection_px"] = model.point_error_px()
    return table
