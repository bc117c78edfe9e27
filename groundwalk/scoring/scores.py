"""Scores of sets of frames: means, medians and accuracy levels, and which frames make up the paper's sets."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.scoring.errors import accuracy_shares

# The paper's sets of frames, by their status.
SUBSETS = {"rp": ["reliable"], "opt": ["optimised"], "rp+opt": ["reliable", "optimised"]}


@dataclass(frozen=True, kw_only=True)
class Score:
    """How well a set of frames is answered; errors in metres and degrees, levels in percent.

    Means are over the answered frames. Medians are over all frames of the set, levels over the `certain` ones, whose
    ground truth can tell: a missing pose is an infinite error. What is infinite or over no frame is NaN.
    """

    frames: int
    answered: int
    certain: int
    mean_m: float
    median_m: float
    mean_deg: float
    median_deg: float
    high: float
    medium: float
    low: float


def score(position_m: ArrayLike, rotation_deg: ArrayLike, certain: NDArray[np.bool_] | None = None) -> Score:
    """The score of frames with errors (N,) in metres and degrees; NaN is a frame without a pose. `certain` (N,): whose
    ground truth can tell if a pose is within an accuracy level; all where None."""
    metres, degrees = np.asarray(position_m, dtype=float), np.asarray(rotation_deg, dtype=float)
    if certain is None:
        certain = np.ones(len(metres), dtype=bool)
    levels = accuracy_shares(metres[certain], degrees[certain])
    return Score(
        frames=len(metres),
        answered=int((np.isfinite(metres) & np.isfinite(degrees)).sum()),
        certain=int(certain.sum()),
        mean_m=_mean(metres),
        median_m=median_error(metres),
        mean_deg=_mean(degrees),
        median_deg=median_error(degrees),
        **{level: 100 * fraction for level, fraction in levels.items()},
    )


def _mean(errors: NDArray[np.float64]) -> float:
    answered = errors[np.isfinite(errors)]
    return float(answered.mean()) if len(answered) else float("nan")


def median_error(errors: NDArray[np.float64]) -> float:
    """The median over frames (N,), a missing pose being infinitely wrong; NaN where that is infinite or of no frame."""
    median = float(np.median(np.where(np.isfinite(errors), errors, np.inf))) if len(errors) else float("nan")
    return median if np.isfinite(median) else float("nan")
