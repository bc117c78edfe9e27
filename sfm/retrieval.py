"""Which frames look alike: a descriptor of each image from the scene's own features, nothing to download.

VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010) with the
normalisation of each word (Arandjelović and Zisserman, "All about VLAD", CVPR 2013) over words learned from the scene.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from groundwalk.sfm.database import Descriptors
from groundwalk.sfm.pairs import Pairs, unique_pairs

Floats = NDArray[np.float32]

_SAMPLES_PER_WORD = 400
_ITERATIONS = 15
_ROWS_AT_ONCE = 512
_COMPONENTS = 64


def vlad(descriptors: Sequence[Descriptors], words: int, seed: int) -> Floats:
    """Unit image descriptors (N, words * D) of N images, each with local descriptors (M, D); zero where M is 0.

    One image at least has local descriptors.
    """
    rng = np.random.default_rng(seed)
    everything = np.concatenate([d for d in descriptors if len(d)])
    chosen = rng.permutation(len(everything))[: words * _SAMPLES_PER_WORD]
    centres = k_means(_unit(everything[np.sort(chosen)]), words, rng)
    return np.stack([_aggregate(_unit(d), centres) if len(d) else _nothing(centres) for d in descriptors])


def pca_vlad(descriptors: Sequence[Descriptors], words: int, seed: int) -> Floats:
    """As `vlad`, of local descriptors in the scene's 64 first principal components, (N, words * 64).

    What few of a scene's features differ in is noise to most of them (Jégou and Chum, "Negative evidences and
    co-occurences in image retrieval", ECCV 2012, section 3). Half the numbers, half the time.
    """
    rng = np.random.default_rng(seed)
    everything = np.concatenate([d for d in descriptors if len(d)])
    chosen = np.sort(rng.permutation(len(everything))[: words * _SAMPLES_PER_WORD])
    sample = _unit(everything[chosen])
    mean = sample.mean(axis=0)
    components = np.linalg.eigh(np.cov((sample - mean).T))[1][:, : -_COMPONENTS - 1 : -1].astype(np.float32)
    centres = k_means((sample - mean) @ components, words, rng)
    return np.stack(
        [_aggregate((_unit(d) - mean) @ components, centres) if len(d) else _nothing(centres) for d in descriptors]
    )


def k_means(points: Floats, clusters: int, rng: np.random.Generator) -> Floats:
    """Centres (clusters, D) of points (M, D) after Lloyd's iterations from random points; fewer where M is less."""
    centres = points[rng.choice(len(points), min(clusters, len(points)), replace=False)]
    for _ in range(_ITERATIONS):
        nearest = _nearest(points, centres)
        counts = np.bincount(nearest, minlength=len(centres))
        order = np.argsort(nearest, kind="stable")
        starts = np.searchsorted(nearest[order], np.flatnonzero(counts))
        # A centre that lost its points stays where it was.
        centres[counts > 0] = np.add.reduceat(points[order], starts) / counts[counts > 0, None]
    return centres


def retrieval_pairs(image_ND: Floats, session_N: ArrayLike, per_frame: int) -> Pairs:
    """Each frame with the `per_frame` most similar frames of other sessions."""
    session_N = np.asarray(session_N)
    found = [np.empty((0, 2), np.int64)]
    for start in range(0, len(image_ND), _ROWS_AT_ONCE):
        rows = np.arange(start, min(start + _ROWS_AT_ONCE, len(image_ND)))
        similarity = image_ND[rows] @ image_ND.T
        similarity[session_N[rows, None] == session_N[None]] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :per_frame]
        known = np.isfinite(np.take_along_axis(similarity, best, axis=1))
        found.append(np.stack([np.broadcast_to(rows[:, None], best.shape)[known], best[known]], axis=1))
    return unique_pairs(np.concatenate(found))


def _unit(descriptors: Descriptors) -> Floats:
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-12)


def _nothing(centres: Floats) -> Floats:
    return np.zeros(centres.size, np.float32)


def _nearest(points: Floats, centres: Floats) -> NDArray[np.int64]:
    # |p - c|^2 without |p|^2, which is the same for every centre.
    return np.argmin(np.sum(centres**2, axis=1) - 2 * points @ centres.T, axis=1)


def _aggregate(points: Floats, centres: Floats) -> Floats:
    nearest = _nearest(points, centres)
    words = np.zeros_like(centres)
    np.add.at(words, nearest, points - centres[nearest])
    words /= np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-12)
    flat = words.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-12)
