"""Pairs of frames as a table: what proposed each, its matches and verified inliers, and its relative pose against VIO.

A row a pair: rows of the frames table `a` < `b`, `origin` (PairOrigin), `matches`, `inliers`, and the columns of
`compare_with_vio`, which are NaN, and without a reason, where a pair has too few inliers for a relative pose.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.store.choices import PairInconsistency, PairStatus
from groundwalk.store.files import written_aside

Booleans = NDArray[np.bool_]
Pairs = NDArray[np.int64]
MIN_INLIERS = 15
"""A pair needs so many verified matches: an essential matrix takes five, and few more agree with it by chance."""
LINK_INLIERS = 30
"""As many as COLMAP's mapper needs to register an image: a pair of fewer doesn't hold a model together."""
FEW_INLIERS = 100
"""Pairs with fewer are matched again where one of their frames has fewer than three pairs of 200 matches or more."""
_GOOD_PAIRS, _MANY_MATCHES = 3, 200


def matched_pairs(
    pairs: Pairs, origin: NDArray[np.str_], matches: NDArray[np.int64], inliers: NDArray[np.int64]
) -> pd.DataFrame:
    """The table of pairs (P, 2) that aren't compared with VIO yet, all of them consistent with it."""
    table = pd.DataFrame({"a": pairs[:, 0], "b": pairs[:, 1], "origin": origin, "matches": matches, "inliers": inliers})
    angles = dict.fromkeys(("rotation", "rotation_limit", "direction", "direction_limit", "gravity"), np.nan)
    return table.assign(**angles, reason=PairInconsistency.NONE.value)


def rows_of(matched: pd.DataFrame) -> Pairs:
    """The pairs (P, 2)."""
    return matched[["a", "b"]].to_numpy(np.int64)


def are_verified(matched: pd.DataFrame) -> Booleans:
    """(P,) the pair has enough inliers and is consistent with VIO."""
    return (matched["inliers"] >= MIN_INLIERS).to_numpy(bool) & (matched["reason"] == PairInconsistency.NONE).to_numpy()


def are_weak(matched: pd.DataFrame) -> Booleans:
    """(P,) few inliers, and one of its frames has few pairs with many matches."""
    pairs = rows_of(matched)
    has_many = (matched["matches"] >= _MANY_MATCHES).to_numpy(bool)
    good_pairs = np.bincount(pairs[has_many].ravel(), minlength=pairs.max(initial=0) + 1)
    is_few = (matched["inliers"] < FEW_INLIERS).to_numpy(bool)
    return is_few & np.asarray((good_pairs < _GOOD_PAIRS)[pairs].any(axis=1))


def status_of(matched: pd.DataFrame) -> NDArray[np.object_]:
    """(P,) values of PairStatus."""
    is_few, reason = (matched["inliers"] < MIN_INLIERS).to_numpy(bool), matched["reason"].to_numpy()
    conditions = [is_few, reason == PairInconsistency.NONE, reason == PairInconsistency.NEIGHBOURS]
    statuses = [PairStatus.TOO_FEW_INLIERS, PairStatus.VERIFIED, PairStatus.INCONSISTENT_WITH_NEIGHBOURS]
    return np.select(conditions, statuses, PairStatus.INCONSISTENT_WITH_VIO).astype(object)


def checkpoint(path: Path, make: Callable[[], pd.DataFrame]) -> pd.DataFrame:
    """The table at `path`; made, and written whole, where it isn't there."""
    if not path.is_file():
        with written_aside(path) as partial:
            make().to_parquet(partial)
    return pd.read_parquet(path)
