"""How far figures would move with other walks: bootstrap confidence intervals over sessions.

Frames of one walk share their error, so frames are no independent samples; sessions are what is drawn again, with
replacement. With few sessions there is little to draw: two sessions have three different draws, so that the interval
runs from one session's figure to the other's and says no more than that.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import ACCURACY_LEVELS

DRAWS = 1000
CONFIDENCE = 0.95


def draws(sessions: int, seed: int | np.random.Generator = 0) -> Array:
    """How often each session is drawn, (1 + DRAWS, S): first each once, then drawn with replacement."""
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(sessions, np.full(sessions, 1 / sessions), size=DRAWS)
    return np.concatenate([np.ones((1, sessions)), drawn])


def drawn_figures(
    position_m: Array, rotation_deg: Array, certain: NDArray[np.bool_], weights: Array
) -> Iterator[tuple[str, Array]]:
    """Name and values (D,) of each figure, for errors (N,) of frames with weights (D, N); levels are over the frames
    whose ground truth is `certain` (N,)."""
    total = weights.sum(axis=1)
    answered = np.isfinite(position_m)
    yield "coverage_pct", 100 * weights @ answered / total
    for name, errors in (("position", position_m), ("rotation", rotation_deg)):
        unit = "m" if name == "position" else "deg"
        yield f"{name}_mean_{unit}", _fraction(weights @ np.where(answered, errors, 0.0), weights @ answered)
        yield f"{name}_median_{unit}", _medians(np.where(answered, errors, np.inf), weights)
    for level, (metres, degrees) in ACCURACY_LEVELS.items():
        within = certain & (position_m <= metres) & (rotation_deg <= degrees)
        yield f"{level}_pct", 100 * _fraction(weights @ within, weights @ certain)


def _fraction(part: Array, whole: Array) -> Array:
    return np.divide(part, whole, out=np.full(len(whole), np.nan), where=whole > 0)


def _medians(errors: Array, weights: Array) -> Array:
    """The median (D,) of errors (N,), each counted as often as weights (D, N) say."""
    order = np.argsort(errors, kind="stable")
    below = np.cumsum(weights[:, order], axis=1)
    half = below[:, -1:] / 2
    middle = [errors[order][np.argmax(reached, axis=1)] for reached in (below >= half, below > half)]
    return np.asarray((middle[0] + middle[1]) / 2)


def interval(values: Array) -> tuple[float | None, float | None]:
    """The middle CONFIDENCE of the values (D,); a bound is None where it is infinite or there is none."""
    known = values[~np.isnan(values)]
    low, high = middle(known) if len(known) else (np.nan, np.nan)
    return finite(low), finite(high)


def middle(values: Array) -> tuple[float, float]:
    """Bounds of the middle CONFIDENCE of values (D,), maybe infinite: the nearest values, not interpolated ones, as
    between a number and infinity there is none."""
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(values, [tail, 100 - tail], method="nearest")
    return float(low), float(high)


def figures_by_session(
    session_N: NDArray[np.object_],
    position_m: Array,
    rotation_deg: Array,
    certain: NDArray[np.bool_],
    seed: int | np.random.Generator = 0,
) -> Iterator[tuple[str, float | None, float | None, float | None]]:
    """Name, value and bounds of each of `drawn_figures`, for errors (N,) of frames of these sessions; without bounds
    where there is a single session, and none of no frames."""
    names = np.unique(session_N)
    if len(names):
        weights = draws(len(names), seed)[:, np.searchsorted(names, session_N)]
        for name, values in drawn_figures(position_m, rotation_deg, certain, weights):
            yield name, finite(values[0]), *(interval(values[1:]) if len(names) > 1 else (None, None))


def finite(value: float) -> float | None:
    """The value, or None where it is infinite or NaN."""
    return float(value) if np.isfinite(value) else None
