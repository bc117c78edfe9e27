"""The kinds of local features that structure localisers may be built from."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from groundwalk.store.registry import Lazy

if TYPE_CHECKING:
    from groundwalk.features.sift import Features

Size = tuple[int, int]
SIFT_RATIO = 0.85


@dataclass(frozen=True)
class FeatureKind:
    """How images are described, and a query is matched with one.

    `extract(grey, max_features, max_side)` gives the features of an image (H, W), the strongest first. `match(query,
    image, query_size, image_size)` gives rows (M, 2) of features that match; descriptors are of unit length, sizes are
    width and height in px. Training frames, whose poses are known, are matched by mutually nearest descriptors whose
    second nearest are farther by `ratio`, where their rays meet.
    """

    id: str
    ratio: float
    extract: "Callable[[NDArray[np.uint8], int, int], Features]" = field(repr=False)
    match: "Callable[[Features, Features, Size, Size], NDArray[np.int64]]" = field(repr=False)


SIFT = FeatureKind(
    "SIFT",
    SIFT_RATIO,
    Lazy("groundwalk.features.sift:sift"),
    Lazy("groundwalk.localisation.matching:match_sift"),
)
XFEAT = FeatureKind(
    "XFeat",
    0.95,
    Lazy("groundwalk.localisation.learned:extract_xfeat"),
    Lazy("groundwalk.localisation.learned:match_xfeat"),
)
