"""How far ground truth may be off: covariance in the map, and the quality class that follows from it.

A pose's error is (rotation, position), both in the axes of the frame it is given in: true rotation =
exp(rotation) @ R, true position = t + position.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array


@dataclass(frozen=True)
class SharedSd:
    """One sigma of what all poses of a map share: relative scale, tilt of the vertical in radians per axis, and a turn
    of all cameras about their own x and y axes, radians each."""

    scale: float
    tilt: float
    camera: float = 0.0


class Measures(NamedTuple):
    """What a frame's class goes by: sigmas of SfM's own part (NaN: not known), image points seen, mean reprojection
    angle."""

    position_sd_m: float
    rotation_sd_deg: float
    observations: float
    reprojection_deg: float


QualityLimits = Measures
"""What a frame must keep for a class."""


def covariance_in_map(covariance_sfm: Array, map_S_sfm: Sim3) -> Array:
    """Covariances (N, 6, 6) of poses in SfM's frame and units, in the map's frame and metres."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = map_S_sfm.rotation
    jacobian[3:, 3:] = map_S_sfm.scale * map_S_sfm.rotation
    return jacobian @ covariance_sfm @ jacobian.T


def shared_covariance(map_T_cam: Array, anchor: Array, sd: SharedSd) -> Array:
    """Covariances (N, 6, 6) of poses (N, 4, 4) from what all of them share.

    A wrong scale or tilt turns and stretches the map about a place that stays; `anchor` (3,) is that place. What all
    keypoints are off by in common turns each camera about its own axes, all alike. Origin and heading of the map are
    free, so they have no error.
    """
    map_T_cam = np.asarray(map_T_cam, dtype=float)
    arm = map_T_cam[:, :3, 3] - anchor
    jacobian = np.zeros((len(arm), 6, 5))
    jacobian[:, 3:, 0] = arm
    for column, axis in ((1, [1.0, 0.0, 0.0]), (2, [0.0, 0.0, 1.0])):
        jacobian[:, :3, column] = axis
        jacobian[:, 3:, column] = np.cross(axis, arm)
    jacobian[:, :3, 3:] = map_T_cam[:, :3, :2]
    variance = np.array([sd.scale, sd.tilt, sd.tilt, sd.camera, sd.camera]) ** 2
    return np.einsum("nij,j,nkj->nik", jacobian, variance, jacobian)


def largest_sd(covariance: Array) -> tuple[Array, Array]:
    """Sigma along the least certain axis of covariances (N, 6, 6): metres and radians (N,); NaN where NaN."""
    sds = np.full((2, len(covariance)), np.nan)
    known = np.isfinite(covariance).all(axis=(1, 2))
    for row, block in ((0, slice(3, 6)), (1, slice(0, 3))):
        largest = np.linalg.eigvalsh(covariance[known, block, block])[:, -1]
        sds[row, known] = np.sqrt(np.maximum(largest, 0.0))
    return sds[0], sds[1]


class Grade(NamedTuple):
    """A frame's quality class, and what keeps it from a better one, with the figure and its limit where there are."""

    quality: str
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


def grade(measures: Measures, a: QualityLimits, b: QualityLimits) -> Grade:
    """The class of a frame with ground truth by the limits of A and B, all of which it must keep; C has none. The limit
    that is exceeded most, as a ratio, is named."""
    for better, below, limits in (("B", "C", b), ("A", "B", a)):
        exceeded = _exceeded(measures, limits)
        if exceeded is not None:
            return Grade(below, *exceeded)
        if better == "A" and np.isnan(measures.position_sd_m):
            return Grade("B", "uncertainty not known")
    return Grade("A")


def _exceeded(measures: Measures, limits: QualityLimits) -> tuple[str, float, float, str] | None:
    """What exceeds its limit most, or None; an uncertainty that isn't known doesn't."""
    few = limits.observations / max(measures.observations, 0.5)
    figures = [
        (measures.position_sd_m / limits.position_sd_m, "position uncertain", 0, "m"),
        (measures.rotation_sd_deg / limits.rotation_sd_deg, "rotation uncertain", 1, "deg"),
        (few, "few points seen", 2, ""),
        (np.nan_to_num(measures.reprojection_deg / limits.reprojection_deg, nan=np.inf), "reprojection", 3, "deg"),
    ]
    ratio, words, place, unit = max(figures, key=lambda figure: np.nan_to_num(figure[0], posinf=np.inf))
    return (words, measures[place], limits[place], unit) if ratio > 1 else None


def count_grades(grades: Sequence[Grade]) -> list[str]:
    """Lines for the user: how many frames are of class B and C for which reason, with the median figure."""
    groups: dict[tuple[str, str], list[Grade]] = {}
    for one in sorted(grades):
        if one.limited_by:
            groups.setdefault((one.quality, one.limited_by), []).append(one)
    return [
        f"{len(group)} {group[len(group) // 2].reason.removeprefix('class ')}" for _, group in sorted(groups.items())
    ]
