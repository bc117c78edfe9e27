"""Passed, failed or undecided: an estimate with its standard error against a limit."""

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Status(StrEnum):
    """What became of a check."""

    PASSED = "passed"
    FAILED = "failed"
    UNDECIDED = "undecided"


SIGMAS = 2.0
"""How many standard errors an estimate must keep from a limit, on either side of it, to be decided."""


def decide(value: float, sd: float, limit: float, *, at_least: bool = False) -> Status:
    """Passed where `value` is within `limit` (at most, or `at_least`) by two `sd` or more, failed where it is beyond by
    more than two, else undecided: a larger `sd` makes neither passing nor failing easier. No value (NaN) is
    undecided."""
    sign = -1.0 if at_least else 1.0
    if beyond(sign * value, sd, sign * limit):
        return Status.FAILED
    return Status.PASSED if within(sign * value, sd, sign * limit) else Status.UNDECIDED


def within(value: ArrayLike, sd: ArrayLike, limit: ArrayLike) -> NDArray[np.bool_]:
    """Whether values are surely at most a limit; arrays that broadcast, False for NaN."""
    return np.asarray(np.asarray(value, float) + SIGMAS * np.asarray(sd, float) <= np.asarray(limit, float))


def beyond(value: ArrayLike, sd: ArrayLike, limit: ArrayLike) -> NDArray[np.bool_]:
    """Whether values are surely above a limit; arrays that broadcast, False for NaN."""
    return np.asarray(np.asarray(value, float) - SIGMAS * np.asarray(sd, float) > np.asarray(limit, float))


def share_sd(share: float, count: float) -> float:
    """Standard error of a share found in `count` independent cases: of the beta posterior under a flat prior, which
    isn't zero where all cases agree."""
    mean = (share * count + 1) / (count + 2)
    return float(np.sqrt(mean * (1 - mean) / (count + 3)))
