"""Passed, failed or undecided: an estimate with its standard error against a limit."""

from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Status(StrEnum):
    """Of a consistency check."""

    PASSED = "passed"
    FAILED = "failed"
    UNDECIDED = "undecided"


SIGMAS = 2.0
"""A check is decided where its estimate is at least so many standard errors away from the limit."""


def decide(value: float, sd: float, limit: float, *, at_least: bool = False) -> Status:
    """Passed where `value` is within `limit` (at most, or `at_least`) by two `sd` or more, failed where it is beyond by
    more than two, else undecided: a larger `sd` makes neither passing nor failing easier. No value (NaN) is
    undecided."""
    sign = -1.0 if at_least else 1.0
    if beyond(sign * value, sd, sign * limit):
        return Status.FAILED
    return Status.PASSED if within(sign * value, sd, sign * limit) else Status.UNDECIDED


def within(value: ArrayLike, sd: ArrayLike, limit: ArrayLike) -> NDArray[np.bool_]:
    """Whether values are below a limit by two standard errors or more; arrays that broadcast, False for NaN."""
    return np.asarray(np.asarray(value, float) + SIGMAS * np.asarray(sd, float) <= np.asarray(limit, float))


def beyond(value: ArrayLike, sd: ArrayLike, limit: ArrayLike) -> NDArray[np.bool_]:
    """Whether values are above a limit by more than two standard errors; arrays that broadcast, False for NaN."""
    return np.asarray(np.asarray(value, float) - SIGMAS * np.asarray(sd, float) > np.asarray(limit, float))


def fraction_sd(fraction: float, count: float) -> float:
    """Standard error of a fraction of `count` independent cases: of the beta posterior under a flat prior, which isn't
    zero where all cases agree."""
    mean = (fraction * count + 1) / (count + 2)
    return float(np.sqrt(mean * (1 - mean) / (count + 3)))
