"""Each frame's quality class, by SfM's uncertainty and evidence."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from groundwalk.alignment.settings import AlignSettings, QualitySettings
from groundwalk.alignment.uncertainty import largest_sd
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import QualityClass


class FrameMeasures(NamedTuple):
    """What a frame's class goes by: standard errors of its pose in SfM (NaN: unknown), points of the model seen in it,
    mean reprojection angle."""

    position_sd_m: float
    rotation_sd_deg: float
    observations: float
    reprojection_deg: float


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
        unit = f" {self.unit}" if self.unit else ""
        figures = f" {self.value:.3g}{unit} (limit {self.limit:g})" if np.isfinite(self.limit) else ""
        return f"class {self.quality}: {self.limited_by}{figures}"


def grade_frames(
    frames: pd.DataFrame, images: pd.DataFrame, covariance: Array, problem: np.ndarray, settings: AlignSettings
) -> list[Grade]:
    """Classes of frames (import's table, and SfM's in its order) by covariances (N, 6, 6) in metres, and why; `problem`
    (N,): what makes a frame C, empty where nothing does."""
    sd_m, sd_rad = largest_sd(covariance)
    observations = images["observations"].to_numpy(float, na_value=0.0)
    # Pixels mean different angles at different image sizes.
    reprojection_deg = np.degrees(
        np.arctan2(images["reprojection_px"].to_numpy(float, na_value=np.nan), frames["fx"].to_numpy(float))
    )
    columns = (column.tolist() for column in (sd_m, np.degrees(sd_rad), observations, reprojection_deg))
    measures = (FrameMeasures(*row) for row in zip(*columns, strict=True))
    return [
        Grade(QualityClass.C, reason) if reason else grade(m, settings.quality_a, settings.quality_b)
        for m, reason in zip(measures, problem, strict=True)
    ]


def grade(measures: FrameMeasures, a: QualitySettings, b: QualitySettings) -> Grade:
    """The class of a frame with ground truth by the limits of A and B, all of which it must keep; C has none. The limit
    that is exceeded most, as a ratio, is named. A frame of unknown uncertainty is no better than an uncertain one."""
    if (exceeded := _exceeded(measures, b)) is not None:
        return Grade(QualityClass.C, *exceeded)
    if np.isnan(measures.position_sd_m):
        return Grade(QualityClass.C, "uncertainty unknown")
    exceeded = _exceeded(measures, a)
    return Grade(QualityClass.A) if exceeded is None else Grade(QualityClass.B, *exceeded)


def _exceeded(measures: FrameMeasures, limits: QualitySettings) -> tuple[str, float, float, str] | None:
    """The limit that is exceeded most, or None; an uncertainty that is unknown exceeds none."""
    m, few = measures, limits.min_observations / max(measures.observations, 0.5)
    position, rotation = m.position_sd_m / limits.max_position_sd_m, m.rotation_sd_deg / limits.max_rotation_sd_deg
    reprojection = np.nan_to_num(m.reprojection_deg / limits.max_reprojection_deg, nan=np.inf)
    ratio, what, value, limit, unit = max(
        (position, "position uncertain", m.position_sd_m, limits.max_position_sd_m, "m"),
        (rotation, "rotation uncertain", m.rotation_sd_deg, limits.max_rotation_sd_deg, "deg"),
        (few, "few points seen", m.observations, limits.min_observations, ""),
        (reprojection, "reprojection", m.reprojection_deg, limits.max_reprojection_deg, "deg"),
        key=lambda entry: np.nan_to_num(entry[0], posinf=np.inf),
    )
    return (what, value, limit, unit) if ratio > 1 else None


def sfm_covariances(column: pd.Series) -> Array:
    """A column of 36 doubles or null as (N, 6, 6), NaN where null."""
    covariance = np.full((len(column), 6, 6), np.nan)
    for row, values in enumerate(column):
        if values is not None and len(values) == 36:
            covariance[row] = np.asarray(values, dtype=float).reshape(6, 6)
    return covariance


def count_grades(grades: Sequence[Grade]) -> list[str]:
    """Lines for the user: how many frames are of class B and C for which reason, with the median figure."""
    groups: dict[tuple[str, str], list[Grade]] = {}
    for one in sorted(grades):
        if one.limited_by:
            groups.setdefault((one.quality, one.limited_by), []).append(one)
    return [
        f"{len(group)} {group[len(group) // 2].reason.removeprefix('class ')}" for _, group in sorted(groups.items())
    ]
