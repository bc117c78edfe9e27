"""Each frame's quality class, by SfM's uncertainty and evidence."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from groundwalk.alignment.uncertainty import largest_sd
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import QualityClass


class FrameEvidence(NamedTuple):
    """What a frame's class goes by: standard errors of its pose in SfM along the least certain axis (NaN: unknown),
    points of the model seen in it, mean reprojection angle."""

    position_sd_m: float
    rotation_sd_deg: float
    observations: float
    reprojection_deg: float


# Limits of the classes, the same in every data set, so that a class means the same everywhere: 95 % bounds (2.8 sigma)
# of A and B lie within 0.25 m and 2 degrees. Whoever needs others has the standard errors in the table.
CLASS_A = FrameEvidence(position_sd_m=0.02, rotation_sd_deg=0.1, observations=100, reprojection_deg=0.15)
CLASS_B = FrameEvidence(position_sd_m=0.05, rotation_sd_deg=0.3, observations=50, reprojection_deg=0.3)
_LIMITED_BY = (
    ("position uncertain", " m"),
    ("rotation uncertain", " deg"),
    ("few points seen", ""),
    ("reprojection", " deg"),
)


class Grade(NamedTuple):
    """A frame's quality class, and what keeps it from a better one, with the figure and its limit where there are."""

    quality: QualityClass
    limited_by: str = ""
    value: float = float("nan")
    limit: float = float("nan")
    unit: str = ""

    @property
    def reason(self) -> str:
        """In words; empty for A."""
        if not self.limited_by:
            return ""
        figures = f" {self.value:.3g}{self.unit} (limit {self.limit:g})" if np.isfinite(self.limit) else ""
        return f"class {self.quality}: {self.limited_by}{figures}"


def grade_frames(frames: pd.DataFrame, images: pd.DataFrame, covariance: Array, problem: np.ndarray) -> list[Grade]:
    """Classes of frames (import's table, and SfM's in its order) by covariances (N, 6, 6) in metres, and why; `problem`
    (N,): what makes a frame C, empty where nothing does."""
    sd_m, sd_rad = largest_sd(covariance)
    observations = images["observations"].to_numpy(float, na_value=0.0)
    # Pixels mean different angles at different image sizes.
    reprojection_px = images["reprojection_px"].to_numpy(float, na_value=np.nan)
    reprojection_deg = np.degrees(np.arctan2(reprojection_px, frames["fx"].to_numpy(float)))
    evidence = np.column_stack([sd_m, np.degrees(sd_rad), observations, reprojection_deg])
    return [
        Grade(QualityClass.C, reason) if reason else grade(FrameEvidence(*row))
        for row, reason in zip(evidence.tolist(), problem, strict=True)
    ]


def grade(evidence: FrameEvidence) -> Grade:
    """The class of a frame with ground truth by the limits of A and B, all of which it must keep; C has none. The limit
    that is exceeded most, as a ratio, is named. A frame of unknown uncertainty is no better than an uncertain one."""
    for quality, limits in ((QualityClass.C, CLASS_B), (QualityClass.B, CLASS_A)):
        ratios = np.array(evidence) / limits
        ratios[:2] = np.nan_to_num(ratios[:2])
        ratios[2] = 1 / max(ratios[2], 1e-3)
        ratios[3] = np.nan_to_num(ratios[3], nan=np.inf)
        worst = int(np.argmax(ratios))
        if ratios[worst] > 1:
            what, unit = _LIMITED_BY[worst]
            return Grade(quality, what, evidence[worst], limits[worst], unit)
        if np.isnan(evidence.position_sd_m):
            return Grade(QualityClass.C, "uncertainty unknown")
    return Grade(QualityClass.A)


def count_grades(grades: Sequence[Grade]) -> list[str]:
    """Lines for the user: how many frames are of class B and C for which reason, with the median figure."""
    groups: dict[tuple[str, str], list[Grade]] = {}
    for one in sorted(grades):
        if one.limited_by:
            groups.setdefault((one.quality, one.limited_by), []).append(one)
    return [f"{len(same)} {same[len(same) // 2].reason.removeprefix('class ')}" for _, same in sorted(groups.items())]
