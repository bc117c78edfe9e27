"""Frames whose verified matches contradict their poses; no others."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.mapping.misplaced import misplaced_frames

PAIRS = np.array(list(combinations(range(9), 2)))


def check_of(wrong: dict[tuple[int, int], float]) -> pd.DataFrame:
    """Ten matches of each pair of nine frames, off by 0.1 px or as stated of pairs."""
    a, b = np.repeat(PAIRS, 10, axis=0).T
    errors = [wrong.get(pair, 0.1) for pair in zip(a.tolist(), b.tolist(), strict=True)]
    return pd.DataFrame({"a": a, "b": b, "error_px": errors})


@pytest.mark.parametrize(
    ("is_wrong", "off_px", "rows"),
    [
        (lambda a, b: 2 in (a, b), 5.0, [2]),  # contradicted by all others
        (lambda a, b: (a in (4, 5)) != (b in (4, 5)), 5.0, [4, 5]),  # two that agree with each other alone
        (lambda a, b: 2 in (a, b), 0.5, [2]),  # the limit follows the errors of the other pairs
        (lambda a, b: 2 in (a, b), 0.35, []),
        (lambda a, b: (a, b) == (0, 1), 5.0, []),  # one wrong pair of many
        (lambda a, b: True, 3.0, []),  # all are off
    ],
)
def test_frames_that_most_of_their_matches_contradict(
    is_wrong: Callable[[int, int], bool], off_px: float, rows: list[int]
) -> None:
    check = check_of({(a, b): off_px for a, b in PAIRS.tolist() if is_wrong(a, b)})
    assert sorted(misplaced_frames(check)) == rows
    assert misplaced_frames(check[:0]) == []
