"""A descriptor of an image from its local descriptors.

VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010) with the
normalisation of each word (Arandjelović and Zisserman, "All about VLAD", CVPR 2013).
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_ITERATIONS = 15


def k_means(points: Floats, clusters: int, rng: np.random.Generator) -> Floats:
    """Centres (clusters, D) of points (M, D) after Lloyd's iterations from random points; fewer where M is less."""
    centres = points[rng.choice(len(points), min(clusters, len(points)), replace=False)]
    for _ in range(_ITERATIONS):
        word = nearest_centres(points, centres)
        counts = np.bincount(word, minlength=len(centres))
        order = np.argsort(word, kind="stable")
        starts = np.searchsorted(word[order], np.flatnonzero(counts))
        # A centre that lost its points stays where it was.
        centres[counts > 0] = np.add.reduceat(points[order], starts) / counts[counts > 0, None]
    return centres


def nearest_centres(points: Floats, centres: Floats) -> NDArray[np.int64]:
    """The nearest of centres (K, D) to each of points (M, D), (M,)."""
    # |p - c|^2 without |p|^2, which is the same for every centre.
    return np.argmin(np.sum(centres**2, axis=1) - 2 * points @ centres.T, axis=1)


def aggregate(points: Floats, centres: Floats) -> Floats:
    """The unit image descriptor (K * D,) of local descriptors (M, D) over centres (K, D)."""
    word = nearest_centres(points, centres)
    words = np.zeros_like(centres)
    np.add.at(words, word, points - centres[word])
    words /= np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-12)
    flat = words.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12), np.float32)
