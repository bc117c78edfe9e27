"""Each frame's quality class, and what VIO has to say about the frames that SfM isn't sure of."""

import numpy as np
import pandas as pd

from alignment.segments import Segment
from alignment.settings import AlignSettings
from alignment.uncertainty import largest_sd, quality_classes
from geometry.fits import Sim3
from geometry.poses import Array, relative


def judge(
    frames: pd.DataFrame, images: pd.DataFrame, own: Array, checked: np.ndarray, settings: AlignSettings
) -> np.ndarray:
    """Classes A, B or C (N,) of frames (import's table, and SfM's in its order) by their own covariances (N, 6, 6) in
    metres; `checked` (N,): compared with VIO, by a focal length that the images don't doubt."""
    sd_m, sd_rad = largest_sd(own)
    judged = pd.DataFrame(
        {
            "position_sd_m": sd_m,
            "rotation_sd_deg": np.degrees(sd_rad),
            "observations": images["observations"].to_numpy(float, na_value=0.0),
            # Pixels mean different angles at different image sizes.
            "reprojection_deg": np.degrees(
                np.arctan2(images["reprojection_px"].to_numpy(float, na_value=np.nan), frames["fx"].to_numpy(float))
            ),
            "checked": checked,
        }
    )
    return quality_classes(judged, {"A": settings.quality_a.limits(), "B": settings.quality_b.limits()})


def sfm_covariances(column: pd.Series) -> Array:
    """A column of 36 doubles or null as (N, 6, 6), NaN where null."""
    covariance = np.full((len(column), 6, 6), np.nan)
    for row, values in enumerate(column):
        if values is not None and len(values) == 36:
            covariance[row] = np.asarray(values, dtype=float).reshape(6, 6)
    return covariance


def contradicted(segment: Segment, metric_S_sfm: Sim3, sure: np.ndarray, step_m: float, share: float) -> np.ndarray:
    """Which frames (N,) of a segment SfM isn't `sure` (N,) of and VIO contradicts: over `step_m` to three times that
    of the path their relative positions differ by more than `share` of it.

    Frames are taken out worst first, until no step with an unsure frame is contradicted.
    """
    known = np.flatnonzero(segment.both)
    along = segment.where(segment.both).travelled_m
    first, last = np.nonzero((along[None] - along[:, None] >= step_m) & (along[None] - along[:, None] <= 3 * step_m))
    unsure = ~sure[known]
    told = unsure[first] | unsure[last]
    first, last = first[told], last[told]
    sfm, vio = metric_S_sfm.poses(segment.sfm_T_cam[known]), segment.vio_T_cam[known]
    apart = relative(sfm[first], sfm[last])[:, :3, 3] - relative(vio[first], vio[last])[:, :3, 3]
    excess = np.linalg.norm(apart, axis=1) / (share * (along[last] - along[first]))
    bad = excess > 1
    out = np.zeros(len(known), dtype=bool)
    while bad.any():
        blame = np.bincount(first[bad], excess[bad], len(known)) + np.bincount(last[bad], excess[bad], len(known))
        worst = int(np.argmax(np.where(unsure, blame, 0.0)))
        out[worst] = True
        bad &= (first != worst) & (last != worst)
    result = np.zeros(len(segment.rows), dtype=bool)
    result[known[out]] = True
    return result
